"""What the values of a truth in text files mean: class ids, class id * 1000 + instance, or numbers of objects alone.

ScanNet's scripts read one file as class ids or as class id * 1000 + instance, by what they evaluate; OpenSUN3D's has
numbers alone. Which of them a file holds is told from its values only where no other reading is possible.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from su3d_bench.core.errors import ConfigError
from su3d_bench.core.types import Int64Array
from su3d_bench.evaluation.request import ValuesForm
from su3d_bench.metrics.fitness import LARGEST_NYU40_ID
from su3d_bench.metrics.instance.average_precision import INSTANCES_PER_CLASS, values_of_numbers
from su3d_bench.metrics.instance.score import OBJECT
from su3d_bench.metrics.protocols.model import ProtocolRules

LARGEST_LABEL = 1357  # of scannetv2-labels.combined.tsv, the longest list of classes that is known here
FORMS: dict[ValuesForm, str] = {
    "classes": "class ids alone",
    "instances": "class id * 1000 + instance",
    "numbers": "numbers of objects alone",
}
BEYOND = (OBJECT + 1) * INSTANCES_PER_CLASS  # values of the label 2: no object where values are numbers
FLAG = "--truth-values"


def check_said(said: ValuesForm | None, *, is_text: bool) -> None:
    """``ConfigError`` where it is said what values of texts are, and the truth is none."""
    if said is not None and not is_text:
        raise ConfigError(
            f"evaluate: {FLAG} says what the texts of --ground-truth hold; leave it out, there are none here"
        )


@dataclass(frozen=True)
class TruthValues:
    """The range of the values of all scenes without 0, both 0 where nothing is annotated, and what they are ``said``
    to be."""

    lowest: int
    highest: int
    said: ValuesForm | None

    @classmethod
    def of(cls, scenes: Iterable[Int64Array], said: ValuesForm | None) -> TruthValues:
        annotated = [values[values > 0] for values in scenes if values.any()]
        lowest = min((int(values.min()) for values in annotated), default=0)
        return cls(lowest, max((int(values.max()) for values in annotated), default=0), said)

    def form(self, rules: ProtocolRules) -> ValuesForm | None:
        """What they are under a protocol; None where they may be one or the other and nobody said which.

        From 1000 to the largest class id they may be instances of the class 1. Then values below 1000 speak for class
        ids where a protocol needs no instances, for as instances they would be of no class.
        """
        if self.said is not None:
            return self.said
        if rules.class_agnostic == "numbered":
            return "numbers"
        if self.highest < INSTANCES_PER_CLASS:
            return "classes"
        if self.highest > max([LARGEST_LABEL, *(entry.id for entry in rules.classes)]):
            return "instances"
        return None if rules.needs_instances or self.lowest >= INSTANCES_PER_CLASS else "classes"

    def why_not(self, rules: ProtocolRules) -> str | None:
        """Why a protocol cannot score against such values."""
        form, values = self.form(rules), f"the values of the ground truth, {self.lowest} to {self.highest},"
        if form is None:
            return (
                f"{values} may be {FORMS['classes']}, or {FORMS['instances']} of class 1; say which with {FLAG} "
                "classes or instances (numbers: of objects alone)"
            )
        if form == "numbers" and (rules.class_agnostic in {None, "scored"}):
            return f"needs classes, and {values} are {FORMS['numbers']}"
        if form != "classes" or not rules.needs_instances:
            return None
        if not self.highest:
            return "needs instances, and every value of the ground truth is 0: nothing is annotated"
        are = f"are said to be {FORMS['classes']}" if self.said else f"are {FORMS['classes']}"
        return (
            f"needs instances, and {values} {are}: {FORMS['instances']} is never below 1000; where they are "
            f"{FORMS['numbers']}, say {FLAG} numbers"
        )

    def doubts(self, rules: ProtocolRules) -> tuple[str, ...]:
        """What makes it doubtful that the labels are those of a protocol."""
        if self.form(rules) == "numbers":
            line = f"values of the ground truth from {BEYOND} up are background, as in OpenSUN3D's script"
            return (line,) if self.highest >= BEYOND else ()
        largest = self.largest_label(rules)
        if rules.ground_truth == "nyu40-vertices" and largest > LARGEST_NYU40_ID:
            return (
                f"the ground truth holds the label {largest}, NYU40 ends at {LARGEST_NYU40_ID}: are these raw ids "
                "of ScanNet200? points of other classes are void",
            )
        if rules.ground_truth == "scannet200-vertices" and largest <= LARGEST_NYU40_ID:
            return (f"the largest label of the ground truth is {largest}: are these NYU40 ids?",)
        return ()

    def largest_label(self, rules: ProtocolRules) -> int:
        """The largest class id among them."""
        return self.highest // INSTANCES_PER_CLASS if self.form(rules) == "instances" else self.highest

    def read(self, values: Int64Array, rules: ProtocolRules) -> tuple[Int64Array, Int64Array]:
        """The values (N,) of a scene as a protocol scores them, and the label (N,) of each point, 0 for none.

        Numbers become 1001, 1002, ... in ascending order, as do all instances under a protocol that goes by numbers
        alone.
        """
        form = self.form(rules)
        if form == "classes":
            return values, values
        if form == "numbers":
            values = values_of_numbers(values)
        if form == "numbers" or rules.class_agnostic == "numbered":
            is_object = values >= INSTANCES_PER_CLASS
            number = np.unique(values[is_object], return_inverse=True)[1]
            values = np.zeros(len(values), np.int64)
            values[is_object] = OBJECT * INSTANCES_PER_CLASS + 1 + number
        return values, values // INSTANCES_PER_CLASS
