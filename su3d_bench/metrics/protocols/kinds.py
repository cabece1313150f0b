"""The kinds of evaluation: the rules that each needs, its values, and what it takes from a map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from su3d_bench.metrics.protocols.model import CURVE_FIELDS, Kind, ProtocolRules, ValuesOfMetric

Allowed = Mapping[str, tuple[object, ...]]
GENERATED: Allowed = {"questions": ("generated",)}
AP_NAMES = ("AP", "AP50", "AP25")
GEOMETRIC = ("on", "under", "in", "above", "next to", "near")  # follow from boxes, see numerics.relations
OBJECT_RANKS = (5, 10, 25, 100, 250, 500)  # config/eval_graph.yaml of hovsg/HOV-SG at 71a8069
CATEGORIES = ("synonyms", "depictions", "vis_sim", "clutter", "missing", "incorrect")


class SemanticRules(ProtocolRules):
    """One class per point."""

    values_of_metric: ClassVar[ValuesOfMetric] = dict.fromkeys(
        ("conceptgraphs", "scannet", "hovsg", "ovo"), ("mAcc", "mIoU", "F-mIoU")
    )
    values_of_groups = ("mAcc", "mIoU")
    candidates = ("object-points",)
    takes_dense = True
    names_points = True
    takes_votes = True
    needs = ("classes", "vocabulary")
    takes = ("unnamed",)


class TopKRules(ProtocolRules):
    """The most likely classes of a point, compared with one label or several."""

    values_of_metric: ClassVar[ValuesOfMetric] = {"scannetpp": ("mIoU", "mAcc")}
    candidates = ("object-points",)
    takes_dense = True
    names_points = True
    needs = ("classes", "vocabulary", "top_k")

    @property
    def value_names(self) -> tuple[str, ...]:
        names = super().value_names
        return (*names, *(f"top-{self.top_k} {name}" for name in names))


class InstanceRules(ProtocolRules):
    """Masks with a class."""

    values_of_metric: ClassVar[ValuesOfMetric] = {"scannet": AP_NAMES}
    values_of_groups = AP_NAMES
    needs_instances = True
    confidences = ("ones", "prediction")
    allowed: ClassVar[Allowed] = {"confidence": confidences}
    takes = ("class_agnostic", "void", "labels")

    def _needed(self) -> tuple[str, ...]:
        if self.class_agnostic is None:
            return ("classes", "vocabulary", *CURVE_FIELDS)
        if self.labels is not None:
            raise ValueError("labels: not allowed if labels are not scored")
        return ("classes", *CURVE_FIELDS) if self.class_agnostic == "scored" else CURVE_FIELDS


class PanopticRules(ProtocolRules):
    """Every point in one segment of a thing or stuff."""

    values_of_metric: ClassVar[ValuesOfMetric] = dict.fromkeys(
        ("panopticapi", "semantic-kitti"),
        tuple(f"{quality}{part}" for part in ("", " things", " stuff") for quality in ("PQ", "SQ", "RQ")),
    )
    needs_instances = True
    needs = ("classes", "vocabulary", "stuff")

    def _needed(self) -> tuple[str, ...]:
        return (*self.needs, "min_region_size") if self.metric == "semantic-kitti" else self.needs


class BoxRules(ProtocolRules):
    """Boxes with a class."""

    values_of_metric: ClassVar[ValuesOfMetric] = {
        "votenet": ("AP25", "AP50", "centroid", "class", "recall25", "recall50", "precision25", "precision50")
    }
    needs_own_points = True
    needs_boxes = True
    transfers = False
    confidences = ("ones", "prediction")
    allowed: ClassVar[Allowed] = {
        "confidence": confidences, "thresholds": ((0.25, 0.5),), "box_axes": ("truth", "world")
    }  # fmt: skip
    needs = ("classes", "vocabulary", "box_axes", *CURVE_FIELDS)


class QueryRules(ProtocolRules):
    """Masks ranked for each text, from a query file or, with ``questions``, from the scene itself."""

    values_of_metric: ClassVar[ValuesOfMetric] = dict.fromkeys(("query-ap", "opensun3d"), AP_NAMES)
    candidates = ("each-mask", "map-points")
    needs_own_points = True
    text_metrics = ("query-ap", "opensun3d")
    confidences = ("similarity", "similarity-min-max")
    allowed: ClassVar[Allowed] = {"confidence": confidences}
    takes = ("top_k", "questions", "per_kind")

    def _needed(self) -> tuple[str, ...]:
        if self.metric == "opensun3d" and self.top_k is not None:
            raise ValueError("top_k: metric 'opensun3d' counts every mask of a scene")
        return ("synonyms", *CURVE_FIELDS) if self.questions == "generated" else CURVE_FIELDS


class CategoryRules(ProtocolRules):
    """How close a point's label is to those of its object."""

    values_of_metric: ClassVar[ValuesOfMetric] = {
        "openlex3d-topn": CATEGORIES,
        "openlex3d-ranking": ("overall", "synonyms", "secondary"),
    }
    candidates = ("object-points",)
    takes_dense = True
    needs_own_points = True
    ignores_classes = False
    text_metrics = ("openlex3d-ranking",)

    @property
    def n_labels(self) -> int | None:
        return self.top_k

    def _needed(self) -> tuple[str, ...]:
        return ("top_k",) if self.metric == "openlex3d-topn" else ()


class GroundingRules(ProtocolRules):
    """The box of the first mask of each text."""

    values_of_metric: ClassVar[ValuesOfMetric] = {
        "scanrefer": tuple(f"{group}Acc@{iou}" for group in ("", "unique ", "multiple ") for iou in ("0.25", "0.5")),
        "referit3d": ("accuracy", "easy", "hard", "view-dependent", "view-independent"),
    }
    needs_own_points = True
    transfers = False
    text_metrics = ("scanrefer", "referit3d")
    needs = ("box_axes",)
    allowed: ClassVar[Allowed] = {"box_axes": ("world", "aligned")}


class RelationRules(ProtocolRules):
    """Objects of a scene graph, predicates between them, and triplets of both."""

    values_of_metric: ClassVar[ValuesOfMetric] = {
        "replicassg": ("object R@1", "predicate R@1", "relationship R@1", "object mR@1", "predicate mR@1")
    }
    needs_instances = True
    needs_cap = True
    takes_voxels = False
    needs = ("classes", "vocabulary", "predicates", "relations")

    def _check_metric(self) -> None:
        super()._check_metric()
        if len(set(self.predicates)) != len(self.predicates):
            raise ValueError("predicates: must not repeat")
        strange = [name for name in self.predicates if name not in GEOMETRIC]
        if self.relations == "geometric" and strange:
            raise ValueError(f"predicates: '{strange[0]}' needs more than boxes; use {', '.join(GEOMETRIC)}")


class _GraphRules(ProtocolRules):
    """Parts of a scene graph, matched one to one with the true ones."""

    needs_own_points = True
    transfers = False


class ObjectRules(_GraphRules):
    """Objects, and the rank of the true category among all."""

    values_of_metric: ClassVar[ValuesOfMetric] = {
        "hovsg-objects": (
            "AUC",
            *(f"top-{k}" for k in OBJECT_RANKS),
            *(f"object {name}" for name in ("AP", "accuracy", "precision", "recall")),
        )
    }
    needs = ("classes", "vocabulary")

    @property
    def n_labels(self) -> int | None:
        """All ranks: the whole ranking counts."""
        return None


class PlaceRules(_GraphRules):
    """Floors and rooms."""

    values_of_metric: ClassVar[ValuesOfMetric] = {
        "hovsg-places": (
            "number of floors",
            *(f"floor {name}" for name in ("accuracy", "precision", "recall")),
            "room precision",
            "room recall",
            *(f"room {name}" for name in ("AP", "accuracy@0.6", "precision@0.6", "recall@0.4")),
        )
    }
    needs_places = True


class _JudgedRules(ProtocolRules):
    """Questions that annotators answer in the originals."""

    is_judged = True
    needs_own_points = True
    needs_cap = True


class RetrievalRules(_JudgedRules):
    """The first mask of each text."""

    values_of_metric: ClassVar[ValuesOfMetric] = {
        "retrieval": ("instance", "affordance", "property", "relative", "all", "by name", "reachable")
    }
    text_metrics = ("retrieval",)
    needs = ("questions", "min_region_size")
    takes = ("per_kind",)

    def _needed(self) -> tuple[str, ...]:
        return (*self.needs, "synonyms") if self.questions == "generated" else self.needs


class ObjectChainRules(_JudgedRules):
    """The first mask of each text that leads to an object."""

    values_of_metric: ClassVar[ValuesOfMetric] = {
        "beacon3d": (
            *("case", "object", "class", "appearance", "geometry", "spatial", "functionality"),
            *("chain", "coarse alone", "fine alone", "neither"),
        )
    }
    text_metrics = ("beacon3d",)
    allowed: ClassVar[Allowed] = GENERATED

    def _needed(self) -> tuple[str, ...]:
        return ("questions", "min_region_size", "synonyms") if self.questions == "generated" else ()


class PresenceQuestionRules(ProtocolRules):
    """Whether such an object exists in the scene."""

    is_judged = True
    needs_own_points = True
    transfers = False
    values_of_metric: ClassVar[ValuesOfMetric] = {
        "pope": tuple(
            f"{measure} {sampling}"
            for sampling in ("random", "popular", "adversarial")
            for measure in ("precision", "recall", "F1", "accuracy", "yes-rate", "AUROC")
        )
    }
    text_metrics = ("pope",)
    needs = ("questions", "min_region_size", "synonyms", "per_kind", "presence")
    allowed: ClassVar[Allowed] = GENERATED


class AnnotationRules(_JudgedRules):
    """Names and shapes of masks."""

    values_of_metric: ClassVar[ValuesOfMetric] = {
        "annotation": (
            *("label n", "label n'", "well-merged", "under-merged", "over-merged"),
            *("well-merged n'", "under-merged n'", "over-merged n'"),
        )
    }
    uses_names = True
    needs = ("min_region_size", "synonyms", "merging")


class ReasoningRules(_JudgedRules):
    """Questions that boxes can answer."""

    values_of_metric: ClassVar[ValuesOfMetric] = {"reasoning": ("answer", "objects")}
    uses_names = True
    needs = ("questions", "min_region_size", "synonyms", "answers")
    takes = ("per_kind",)
    allowed: ClassVar[Allowed] = GENERATED


RULES_OF_KIND: dict[Kind, type[ProtocolRules]] = {
    "semantic": SemanticRules,
    "top-k": TopKRules,
    "instance": InstanceRules,
    "panoptic": PanopticRules,
    "boxes": BoxRules,
    "queries": QueryRules,
    "categories": CategoryRules,
    "grounding": GroundingRules,
    "object-chains": ObjectChainRules,
    "relations": RelationRules,
    "objects": ObjectRules,
    "places": PlaceRules,
    "retrieval": RetrievalRules,
    "presence": PresenceQuestionRules,
    "annotation": AnnotationRules,
    "reasoning": ReasoningRules,
}
