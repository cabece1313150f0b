"""The paper's prompts, word for word where the paper has them."""

from __future__ import annotations

import json
from collections.abc import Sequence

# opensu3d.tex, section III-A.
DESCRIBE = "Give name and description to the object. Output e.g. `name':`description'"
# opensu3d.tex, section III-C. The paper prints no more; how to answer is ours, so that the reply can be read.
REFINE = "assign a single name to the object based on a given list of names"
REFINE_FORM = "Answer with that name alone."
# opensu3d.tex, section III-E, the six points of the prompting strategy.
STRATEGY = (
    "Use `Name' & `Description' to understand object.",
    "Use `ID' to refer object.",
    "Use `Cartesian Coordinates'.",
    "Get `Centroid' & `Bounding Box' information.",
    "Compute `Euclidean Distance' if necessary.",
    "Assume `Tolerance' if necessary.",
)


def list_of_names(names: Sequence[str]) -> str:
    """The names as they are given to the model."""
    return json.dumps(list(names), ensure_ascii=False)
