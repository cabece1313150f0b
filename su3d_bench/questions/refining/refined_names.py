"""The file of labels n' beside a map, which itself stays as the run sealed it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import StoreError
from su3d_bench.core.files.atomic import read_json, write_json
from su3d_bench.core.maps import Instances
from su3d_bench.metrics.questions.score import RefinedNames
from su3d_bench.questions.refining.refinement import RefinedName, TopNames
from su3d_bench.questions.truths import voted_names
from su3d_bench.questions.undesired import FilterConfig, undesired
from su3d_bench.store.run_folder import JobFolder

log = logging.getLogger(__name__)
FILE_NAME = "refined_names.json"
SCHEMA = 2
Refiner = Literal["vote", "model"]


class NameRecord(BaseModel):
    """Labels n and n' of one instance, the names that n' was chosen from, and why n' leaves it out, '' where not."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: int
    label: str
    refined: str
    source: Literal["model", "vote", "label"]
    reason: str
    candidates: tuple[str, ...]
    request: str
    left_out: str


class NameRecords(BaseModel):
    """Labels n' of a map and the filter that goes with them; ``prediction_sha256`` ties them to the map.

    ``model`` is empty for the vote.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_version: int
    prediction_sha256: str
    refiner: Refiner
    model: str
    top_m: int
    filter: FilterConfig
    names: tuple[NameRecord, ...]

    @property
    def refined(self) -> RefinedNames:
        who = f"the model {self.model}" if self.refiner == "model" else "the vote"
        return RefinedNames(
            tuple(record.refined for record in self.names),
            f"{who} of su3d-bench runs refine, names of {self.top_m} views",
            tuple(record.left_out for record in self.names),
        )


def records_of(
    job: JobFolder,
    instances: Instances,
    tops: Sequence[TopNames],
    refined: Sequence[RefinedName],
    refiner: Refiner,
    model: str,
    top_m: int,
    config: FilterConfig,
) -> NameRecords:
    """The records of one map, an instance each; what is large background under its label n' is left out."""
    ids = instances.ids.tolist() if len(instances.ids) else range(len(instances))
    left_out = undesired(instances, [name.name for name in refined], config)
    names = tuple(
        NameRecord(
            id=one_id,
            label=top.label,
            refined=name.name,
            source=name.source,
            reason=name.reason,
            candidates=top.names,
            request=name.key,
            left_out=reason,
        )
        for one_id, top, name, reason in zip(ids, tops, refined, left_out, strict=True)
    )
    return NameRecords(
        schema_version=SCHEMA,
        prediction_sha256=digest_file(job.prediction),
        refiner=refiner,
        model=model,
        top_m=top_m,
        filter=config,
        names=names,
    )


def write_records(job: JobFolder, records: NameRecords) -> Path:
    """Write the file beside the map; its path."""
    job.prepare()
    path = job.path / FILE_NAME
    write_json(path, records.model_dump(mode="json"))
    return path


def read_records(job: JobFolder) -> NameRecords | None:
    """Labels n' of the map; None where there are none, a ``StoreError`` where they belong to another map."""
    path = job.path / FILE_NAME
    if not path.is_file():
        return None
    try:
        content = read_json(path)
        if isinstance(content, dict) and content.get("schema_version") == 1:
            raise StoreError(f"{path}: knows no filter of large background yet; give su3d-bench runs refine again")
        records = NameRecords.model_validate(content)
    except (ValidationError, RecursionError) as error:
        raise StoreError(f"{path}: is not as su3d-bench runs refine writes it; give that command again") from error
    if records.schema_version != SCHEMA or records.prediction_sha256 != digest_file(job.prediction):
        raise StoreError(
            f"{path}: belongs to another map than {job.prediction.name}; give su3d-bench runs refine again"
        )
    return records


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
    return records.refined
