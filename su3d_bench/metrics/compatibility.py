"""Whether a protocol can score a prediction against a ground truth, decided from plain facts before any work.

Each ``why_not_...`` returns the reason as a clause without the protocol's name, None if there is none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from su3d_bench.core.maps import Instances, Partition, Prediction
from su3d_bench.metrics.graphs import NEEDS_PLACES
from su3d_bench.metrics.matching.labelling import has_every_label
from su3d_bench.metrics.open_vocabulary.score import NEEDS_FEATURES
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.questions.score import labels_n

if TYPE_CHECKING:
    from su3d_bench.core.maps import Masks
    from su3d_bench.core.types import BoolArray, IntArray

ONE, SEVERAL = "one label", "the top labels of a mask"
MIN_MULTI_LABEL_SHARE = 0.5  # of the masks; single masks can occur twice by chance


def labels_counted(rules: ProtocolRules, *, by_features: bool, are_several: bool = False) -> str | None:
    """Which labels a number under a protocol is based on; None if labels are not scored.

    ``by_features``: the protocol classified the prediction's features, which rank every label. ``are_several``: masks
    occur with several labels each.

    >>> from su3d_bench.metrics.protocols.loading import load_protocol
    >>> labels_counted(load_protocol("openlex3d-topn"), by_features=True)
    'the top 5 labels'
    >>> labels_counted(load_protocol("scannet-instance"), by_features=True)
    'one label'
    """
    if rules.n_labels is None:
        return None
    if rules.n_labels > 1 and (by_features or are_several):
        return f"the top {rules.n_labels} labels"
    return SEVERAL if are_several and rules.names_masks else ONE


def labels_taken(rules: ProtocolRules) -> str:
    """Which of the two a protocol accepts, as a clause.

    >>> from su3d_bench.metrics.protocols.loading import load_protocol
    >>> labels_taken(load_protocol("scannet-instance"))
    'one label of a mask, or the top ones; never both in a ranking'
    """
    if rules.n_labels is None:
        return "no label counts"
    if rules.n_labels > 1:
        return f"the top {rules.n_labels} labels of features, or one label each; never both in one prediction"
    if not rules.names_masks:
        return "one label"
    only = {"one": "one label of a mask", "top-k": "the top labels of a mask"}
    return only[rules.labels] if rules.labels else "one label of a mask, or the top ones; never both in a ranking"


def under_several_labels(masks: Masks, labels: Sequence[str | int]) -> BoolArray:
    """Whether each mask also occurs, with the same points, under another label; never for empty masks.

    >>> import numpy as np
    >>> from su3d_bench.core.maps import Masks
    >>> masks = Masks.of_sets([np.array([1, 2]), np.array([3]), np.array([1, 2]), np.array([3])])
    >>> under_several_labels(masks, ("chair", "lamp", "stool", "lamp")).tolist()
    [True, False, True, False]
    """

    keys = [blake2b(masks.mask(k).tobytes(), digest_size=16).digest() for k in range(len(masks))]
    seen: dict[bytes, set[str | int]] = {}
    for key, label in zip(keys, labels, strict=True):
        seen.setdefault(key, set()).add(label)
    return np.array([len(seen[key]) > 1 for key in keys], bool) & (masks.sizes > 0)


LARGEST_NYU40_ID = 40
# Ground truths of ScanNet and the class ids that they have.
ID_LISTS = {"nyu40-vertices": "ids of NYU40 do", "scannet200-vertices": "ids of ScanNet200 do"}

Form = Literal["instances", "partition", "dense", "vertex-masks", "vertex-labels"]


@dataclass(frozen=True)
class TruthFacts:
    """What a ground truth provides.

    ``label_space`` is None if unknown. ``has_points``: its points have coordinates; ``knows_questions``: it has
    questions with all right answers; ``further``: for each additional label space, the ground truth with its labels.
    """

    name: str
    label_space: str | None
    variants: tuple[str, ...]
    has_points: bool = True
    has_instances: bool = True
    knows_questions: bool = False
    further: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_dataset(cls, dataset: Any) -> TruthFacts:
        """The facts of a dataset, class or object."""
        return cls(
            dataset.name,
            dataset.label_space,
            tuple(dataset.variants),
            knows_questions=hasattr(dataset, "queries"),
            further=getattr(dataset, "extra_ground_truths", {}),
        )


@dataclass(frozen=True)
class ContentFacts:
    """What a prediction of a scene contains.

    ``form``: ``vertex-masks`` and ``vertex-labels`` (one class per point) are over the points of the ground truth, the
    others have their own. ``n``: number of masks or rows of features. ``n_dimensions``: of the features, None without
    any. ``has_names``: some instance has a name or label. ``class_ids``: classes given as ids of the label space.
    ``n_points``: number of ground-truth points that it covers, None if it has its own or states no number.
    ``n_several``: number of masks that also occur with another label. ``has_places``: it has floors and rooms.
    """

    form: Form
    n: int
    n_dimensions: int | None = None
    has_labels: bool = False
    has_every_label: bool = False
    has_names: bool = False
    class_ids: IntArray | None = None
    n_points: int | None = None
    n_several: int = 0
    has_places: bool = False

    @property
    def are_several(self) -> bool:
        """Whether its masks occur with several labels each."""
        return self.n > 0 and self.n_several >= MIN_MULTI_LABEL_SHARE * self.n

    @classmethod
    def of(cls, prediction: Prediction) -> ContentFacts:
        """The facts of a prediction with its own points."""
        features = prediction.features
        n_dimensions = None if features is None else int(features.shape[-1])
        if isinstance(prediction, Instances):
            return cls(
                form="instances",
                n=len(prediction),
                n_dimensions=n_dimensions,
                has_labels=prediction.labels is not None,
                has_every_label=has_every_label(prediction),
                has_names=any(labels_n(prediction)),
                has_places=prediction.places is not None,
            )
        return cls(
            "partition" if isinstance(prediction, Partition) else "dense", len(prediction.features), n_dimensions
        )

    @property
    def has_own_points(self) -> bool:
        return self.form not in ("vertex-masks", "vertex-labels")


def truth_incompatibility(rules: ProtocolRules, truth: TruthFacts) -> str | None:
    """Why no prediction can be scored under a protocol against a ground truth."""
    if (rules.asks or rules.needs_boxes) and not truth.has_points:
        return "needs the objects of a dataset; name one with --dataset"
    if rules.needs_instances and not truth.has_instances:
        return "needs instances, the ground truth has class ids only (expected class id * 1000 + instance)"
    if truth.label_space is None or truth.further.get(rules.label_space) == rules.ground_truth:
        return None
    if rules.label_space != truth.label_space:
        return f"it scores the labels of '{rules.label_space}', {truth.name} has those of '{truth.label_space}'"
    if rules.ground_truth not in truth.variants:
        return f"it needs ground truth '{rules.ground_truth}', {truth.name} has {', '.join(truth.variants)}"
    if rules.questions == "dataset" and not truth.knows_questions:
        return f"it needs a dataset with questions and answers, which {truth.name} does not have"
    return None


def needs_map(rules: ProtocolRules) -> bool:
    """Whether a protocol scores masks over vertices only as a map of the points of these vertices."""
    return rules.needs_own_points and not rules.uses_names and not rules.needs_places


def content_incompatibility(rules: ProtocolRules, content: ContentFacts, *, has_points: bool = True) -> str | None:
    """Why such a prediction cannot be scored under a protocol; ``has_points``: ground truth has coordinates."""
    if rules.needs_own_points and not has_points:
        return f"needs ground truth of the form '{rules.ground_truth}', which neither a dataset nor text files provide"
    has_ids = content.class_ids is not None and len(content.class_ids) > 0
    if rules.class_numbers != "ids" and rules.class_agnostic is None and has_ids:
        return (
            "its files number the classes by their index in the list, these are read as class ids; name the "
            "format with such numbers with --input-format"
        )
    if rules.needs_own_points and not content.has_own_points:
        return "needs a map with its own points, the prediction is over the points of another ground truth"
    if content.has_own_points:
        if not has_points:
            return "the prediction has its own points, the ground truth has no coordinates; name a --dataset"
        return map_incompatibility(rules, content) or _naming_incompatibility(rules, content)
    if content.form == "vertex-labels":
        if rules.needs_instances:
            return "needs instances, the prediction has one class per point"
        can_count = has_points or rules.metric in {"scannet", "ovo"}
        return None if can_count else "needs the coordinates of the points; name a --dataset"
    if rules.names_points and not has_points:
        return "needs a class for every point, the prediction has masks; name a --dataset to convert them to a map"
    return _naming_incompatibility(rules, content)


def kind_incompatibility(rules: ProtocolRules, prediction: Prediction) -> str | None:
    """Why the protocol cannot score this kind of prediction at all; None if it can."""
    facts = ContentFacts.of(prediction)
    if rules.labels is not None and isinstance(prediction, Instances) and prediction.labels is not None:
        facts = replace(facts, n_several=int(under_several_labels(prediction, prediction.labels).sum()))
    reason = map_incompatibility(rules, facts)
    return f"{rules.name}: {reason}" if reason else None


def map_incompatibility(rules: ProtocolRules, content: ContentFacts) -> str | None:
    """Why a protocol cannot score a map with its own points at all."""
    if not rules.takes_dense and content.form == "dense":
        return "needs instances, and the method gives one feature per point"
    if (reason := _label_incompatibility(rules, content)) is not None:
        return reason
    if rules.needs_places and content.n and not content.has_places:
        return NEEDS_PLACES
    if rules.uses_names:
        if content.form != "instances":
            return "needs instances with names, and the method gives a partition"
        return "needs names, and the instances of the method have none" if content.n and not content.has_names else None
    return NEEDS_FEATURES if rules.compares_texts and content.n_dimensions is None and content.n else None


def _label_incompatibility(rules: ProtocolRules, content: ContentFacts) -> str | None:
    """Why masks with one label or several cannot be scored if a protocol accepts only the other."""
    if rules.labels is None or not content.n or content.are_several == (rules.labels == "top-k"):
        return None
    given = "the same masks have several" if content.are_several else "each mask has one"
    return f"takes {'one label' if rules.labels == 'one' else 'the top labels'} of a mask, and {given}"


def _naming_incompatibility(rules: ProtocolRules, content: ContentFacts) -> str | None:
    """Why masks cannot get the classes that a protocol needs."""
    if rules.class_agnostic is not None or (rules.needs_own_points and not rules.vocabulary) or not content.n:
        return None
    if content.form == "vertex-masks" and (reason := _label_incompatibility(rules, content)) is not None:
        return reason
    if not content.has_labels and content.n_dimensions is None:
        is_map = content.has_own_points
        what = "the instances have neither labels" if is_map else "the masks have neither classes"
        return f"needs classes, {what} nor features"
    return None


def class_id_incompatibility(rules: ProtocolRules, content: ContentFacts) -> str | None:
    """Why class ids cannot be those of a protocol, if its label space has two lists of ids."""
    ids = content.class_ids
    if rules.class_agnostic is not None or rules.ground_truth not in ID_LISTS or ids is None or not ids.any():
        return None
    largest = int(ids.max())
    variant = list_of_ids(largest)
    return (
        None if variant == rules.ground_truth else f"the predicted classes go up to {largest}, as {ID_LISTS[variant]}"
    )


def list_of_ids(largest: int) -> str:
    """The ground truth whose list of class ids goes up to the given one."""
    return "nyu40-vertices" if largest <= LARGEST_NYU40_ID else "scannet200-vertices"


def length_mismatch(content: ContentFacts, n_points: int) -> str | None:
    """Why a prediction cannot be over the ``n_points`` points of a ground truth."""
    if content.n_points in {None, n_points}:
        return None
    what = "labels" if content.form == "vertex-labels" else "masks"
    return (
        f"the {what} are of {content.n_points} points, the ground truth has {n_points}; both must be over the vertices "
        "of one mesh, in its order"
    )


def n_feature_dimensions(rules: ProtocolRules, content: ContentFacts) -> int | None:
    """The dimensions of the features to classify; None if there are labels or the protocol needs none."""
    if rules.class_agnostic is not None or rules.uses_names or rules.needs_places or not content.n:
        return None
    has_names = content.has_labels if content.form == "vertex-masks" else content.has_every_label
    return None if has_names and not (content.has_own_points and rules.compares_texts) else content.n_dimensions
