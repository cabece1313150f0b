"""How many labels of a mask or point a number is of: one, or the likeliest of several. The two do not compare.

OpenMask3D gives each mask its likeliest class; Mask3D, Open-YOLO 3D and others list the same mask under one class after
another and keep the best pairs, which can only find more. OpenLex3D takes the likeliest five labels of a feature.
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b
from typing import TYPE_CHECKING

from su3d_bench.metrics.protocols.model import ProtocolRules

if TYPE_CHECKING:
    from su3d_bench.core.maps import Masks
    from su3d_bench.core.types import BoolArray

ONE, SEVERAL = "one label", "the top labels of a mask"
LEAST_SEVERAL = 0.5  # of the masks; single masks can be there twice by chance


def labels_counted(rules: ProtocolRules, *, by_features: bool, are_several: bool = False) -> str | None:
    """What a number under a protocol is of; None where no label counts.

    ``by_features``: the protocol named what the prediction left to features, which rank every label. ``are_several``:
    masks stand there under several labels each.

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
    """Which of the two a protocol takes, as a clause.

    >>> from su3d_bench.metrics.protocols.loading import load_protocol
    >>> labels_taken(load_protocol("scannet-instance"))
    'one label of a mask, or the top ones; never both in a ranking'
    """
    if rules.n_labels is None:
        return "no label counts"
    if rules.n_labels > 1:
        return (
            f"the top {rules.n_labels} labels of features, or one label each; never both in a prediction or a ranking"
        )
    if not rules.names_masks:
        return "one label"
    only = {"one": "one label of a mask", "top-k": "the top labels of a mask"}
    return only[rules.labels] if rules.labels else "one label of a mask, or the top ones; never both in a ranking"


def under_several_labels(masks: Masks, labels: Sequence[str | int]) -> BoolArray:
    """Whether the same points stand there under another label too, of each mask; empty masks do not.

    >>> import numpy as np
    >>> from su3d_bench.core.maps import Masks
    >>> masks = Masks.of_sets([np.array([1, 2]), np.array([3]), np.array([1, 2]), np.array([3])])
    >>> under_several_labels(masks, ("chair", "lamp", "stool", "lamp")).tolist()
    [True, False, True, False]
    """
    import numpy as np

    keys = [blake2b(masks.mask(k).tobytes(), digest_size=16).digest() for k in range(len(masks))]
    seen: dict[bytes, set[str | int]] = {}
    for key, label in zip(keys, labels, strict=True):
        seen.setdefault(key, set()).add(label)
    return np.array([len(seen[key]) > 1 for key in keys], bool) & (masks.sizes > 0)
