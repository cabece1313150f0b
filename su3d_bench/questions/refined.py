"""Labels n' of a map of a run: those of the file beside it, else by vote."""

from __future__ import annotations

import logging

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import StoreError
from su3d_bench.core.types import Instances
from su3d_bench.metrics.questions.truths import RefinedNames
from su3d_bench.questions.refined_names import FILE_NAME, read_records
from su3d_bench.questions.truths import voted_names
from su3d_bench.store.run_folder import JobFolder

log = logging.getLogger(__name__)


def refined_digest(job: JobFolder) -> dict[str, str]:
    """What of the file moves numbers, for the key of the scores; nothing where there is none."""
    path = job.path / FILE_NAME
    return {"refined": digest_file(path)} if path.is_file() else {}


def refined_names(job: JobFolder, instances: Instances) -> RefinedNames | None:
    """Labels n' of the map in ``job``; a file that belongs to another map is passed over with a warning."""
    try:
        records = read_records(job)
    except StoreError as error:
        log.warning("%s; n' is the vote until then", error)
        records = None
    if records is None or len(records.names) != len(instances):
        return voted_names(instances)
    who = f"the model {records.model}" if records.refiner == "model" else "the vote"
    return RefinedNames(records.refined, f"{who} of su3d-bench refine, names of {records.top_m} views")
