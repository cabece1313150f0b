"""The paper's settings as the pipeline's, and the other way round."""

from __future__ import annotations

from dataclasses import asdict, fields, replace

from literal_paper import PaperSettings

from su3d_bench.opensu3d.config import OpenSU3DConfig

# Of an image's points of instances in one voxel the pipeline keeps the last.
OURS = PaperSettings(in_one_voxel="last")


def config_of(settings: PaperSettings) -> OpenSU3DConfig:
    """The pipeline's configuration that is meant to do what ``settings`` say."""
    words = {name: value for name, value in asdict(settings).items() if name in OpenSU3DConfig.model_fields}
    return OpenSU3DConfig(border_pixels="drop" if settings.background_pixels == "drop" else "background", **words)


def settings_of(config: OpenSU3DConfig) -> PaperSettings:
    """What the paper's program must be told to do as ``config`` says."""
    words = config.effective()
    return replace(OURS, **{one.name: words[one.name] for one in fields(PaperSettings) if one.name in words})
