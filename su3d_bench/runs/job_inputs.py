"""What decides the numbers of a job: the full keys under which its steps are sealed, and what is said of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from su3d_bench.core.digests import digest_json, package_versions
from su3d_bench.core.interfaces import Method
from su3d_bench.core.types import SceneInfo
from su3d_bench.metrics.protocols import load_protocol
from su3d_bench.perception.profiles import Perception
from su3d_bench.questions.refined import refined_digest
from su3d_bench.runs.job import MethodOutcome, SceneJob
from su3d_bench.store.run_folder import JobFolder

LAYOUTS_OF_ROOMS = ("replica", "scannet", "tum")  # in which `datasets make rooms` writes files
TRUE_PROPOSALS_CAVEAT = "proposals from the ground truth; a ceiling, not a result"
DEVICE, CPU = "perception.models.device", '"cpu"'
TORCH_PACKAGES = ("torch", "transformers")  # what computes where not all is done by the packages of every key
NAMED_KINDS = ("annotation", "reasoning")  # labels n' of a file beside the map move their numbers


@dataclass(frozen=True)
class JobInputs:
    """One scene under one method, with its data and perception known; ``config`` is what ``config_key`` gives."""

    job: SceneJob
    name: str
    config: Mapping[str, str]
    method: Method
    info: SceneInfo
    perception: Perception
    data_digest: str

    def predict_key(self) -> dict[str, str]:
        """The key of the prediction."""
        key = {**self.config, "data": self.data_digest}
        if self.method.needs.frames:
            key |= {"profile": self.perception.profile, "perception": self.perception.digest}
            if self.perception.profile == "paper" or self.config.get(DEVICE, CPU) != CPU:
                key |= {f"packages.{name}": text for name, text in package_versions(TORCH_PACKAGES).items()}
        return key

    def score_key(self, predict_key: Mapping[str, str], folder: JobFolder) -> dict[str, str]:
        """The key of the scores and pictures of that prediction."""
        rules = {name: load_protocol(name) for name in self.job.protocols}
        key = {"predict": digest_json(predict_key), "encoder": self.perception.encoder.digest}
        key |= {"pictures": str(self.job.pictures)}
        key |= {f"protocol.{name}": one.digest for name, one in rules.items()}
        return key | refined_digest(folder) if any(one.kind in NAMED_KINDS for one in rules.values()) else key

    def outcome(self, remarks: Mapping[str, Any], *, was_resumed: bool) -> MethodOutcome:
        """The outcome once both steps are sealed; ``remarks`` stand beside the seal of the scores."""
        return MethodOutcome(
            self.job.scene,
            self.name,
            profile=self.perception.profile if self.method.needs.frames else None,
            caveat=caveat_of(self.method, self.perception, self.info),
            encoder=self.perception.encoder.name,
            encoder_digest=self.perception.encoder.digest,
            data_digest=self.data_digest,
            was_resumed=was_resumed,
            unscored=tuple(remarks["unscored"].items()),
            warnings=tuple(remarks["warnings"]),
        )


def caveat_of(method: Method, perception: Perception, scene: SceneInfo) -> str | None:
    """What must be said beside every number: where the scenes, the masks, or the method's own proposals come from."""
    own = TRUE_PROPOSALS_CAVEAT if method.needs.true_proposals else getattr(method, "caveat", None)
    is_seen_by_profile = method.needs.frames and not getattr(method, "has_own_perception", False)
    is_made = scene.image_domain == "rendered-rooms" and scene.dataset in LAYOUTS_OF_ROOMS
    made = f"made rooms in the layout of {scene.dataset}, not its scenes" if is_made else None
    parts = [made, perception.caveat if is_seen_by_profile else None, own]
    return "; ".join(part for part in parts if part) or None
