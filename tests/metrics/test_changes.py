"""Changes of scenes on a hand-worked timeline: ghosts, times, wrong merges, Khronos' measures, t-AP.

Six updates of frames 0, 5, ... 25; the change is at frame 10. Object 1 stays, 2 is moved, 3 vanishes, 4 appears; each
place has ten points, and ten points are background.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from su3d_bench.core.maps import Masks
from su3d_bench.metrics import changes
from su3d_bench.metrics.changes import NEVER, MapAt, Places, change_values, count_changes, count_stages
from su3d_bench.metrics.instance.average_precision import THRESHOLDS, combine

OF_1, OLD_2, NEW_2, OF_3, OF_4 = range(5)
SEEN_AFTER, EMPTY_AFTER = (1, 1, 3, 1, 4), (NEVER, 4, NEVER, 5, NEVER)
PLACE = np.append(np.repeat(np.arange(5), 10), np.full(10, -1))
IS_NEW, IS_LEFT = np.isin(range(5), (NEW_2, OF_4)), np.isin(range(5), (OLD_2, OF_3))
TIMES = np.append(SEEN_AFTER, 1)[PLACE], np.append(EMPTY_AFTER, NEVER)[PLACE]
PLACES = Places(np.array([1, 2, 2, 3, 4]), IS_NEW, IS_LEFT, 10, PLACE, *TIMES, [0, 5, 10, 15, 20, 25])
perfect = PLACES.perfect  # what is there and has been seen; an object keeps its id


def points(*places: int) -> list[int]:
    return [k for k, place in enumerate(PLACE.tolist()) if place in places]


def at(n_updates: int, instances: Mapping[int, Sequence[int]]) -> MapAt:
    """The map after ``n_updates``: id -> points."""
    masks, ids = Masks.of_sets([np.array(own, np.int64) for own in instances.values()]), np.array(list(instances))
    return PLACES.map_at(n_updates, masks, ids, np.ones(len(ids)))


def hoarder(n_updates: int) -> MapAt:
    """A map that never removes: an instance for each place seen so far."""
    return at(n_updates, {r + 1: points(r) for r in range(5) if SEEN_AFTER[r] <= n_updates})


def values(maps: Sequence[MapAt]) -> Mapping[str, float]:
    return change_values([count_changes(PLACES, maps)])


def test_map_that_never_removes_has_the_hand_worked_ghost_rate() -> None:
    """At the end 2 of 5 instances are where nothing is; at update 4 the vacated place of object 3 is not yet seen."""
    found = values([hoarder(n) for n in (2, 4, 6)])
    assert (found["ghosts"], found["ghost points"]) == (2 / 5, 20 / 50)
    assert (found["ghosts online"], found["ghost points online"]) == (3 / 10, 30 / 100)
    assert found["removed"] == 0 and np.isnan(found["updates until removed"])
    assert changes.ghosts(hoarder(2)).tolist() == [0, 3, 0, 30]


def test_answer_to_where_is_right_if_the_instance_is_mostly_there() -> None:
    """The map has the moved object at its new place, the vanished one as a ghost, and an instance of background."""
    last = at(6, {2: points(NEW_2) + points(OF_1)[:3], 3: points(OF_3), 9: points(-1) + points(OF_4)[:9]})
    asked = np.array([NEW_2, NEW_2, OLD_2, OF_4, OF_3, OF_3])
    assert changes.answers(last, asked, np.array([0, 1, 0, 2, 1, -1])).tolist() == [2, 6]
    assert changes.answers(at(6, {}), np.array([NEW_2]), np.array([-1])).tolist() == [0, 1]


def test_true_instances_have_no_ghosts_and_f1_1() -> None:
    maps = [perfect(n) for n in range(1, 7)]
    found = values(maps)
    assert found["ghosts"] == found["ghost points"] == found["ghosts online"] == found["wrong merges"] == 0
    for name in ("Object", "Appeared", "Disappeared", "Change"):
        assert [found[f"{name}{ratio}"] for ratio in ("Precision", "Recall", "F1")] == [1, 1, 1]
    assert (found["found"], found["updates until found"]) == (1, 0)
    assert (found["removed"], found["updates until removed"]) == (1, 0)
    assert combine([count_stages(PLACES, [maps[1], maps[5]], THRESHOLDS)], THRESHOLDS).ap == 1


def test_times_are_counted_from_the_update_that_shows_the_change() -> None:
    """Object 2 is seen at its new place after 3 updates and found in the map after 5; object 4 never. The place of 2 is
    seen empty after 4 and cleared in the map after 6, that of 3 after 5 and in the same map."""
    here = {2: points(OLD_2), 3: points(OF_3)}
    maps = [at(3, here), at(4, here), at(5, here | {9: points(NEW_2)}), at(6, {9: points(NEW_2)[:6]})]
    found = values(maps)
    assert (found["found"], found["updates until found"]) == (1 / 2, 5 - 3)
    assert (found["removed"], found["updates until removed"]) == (1, ((6 - 4) + (6 - 5)) / 2)
    assert values(maps[:3])["removed"] == 0


def test_object_is_found_from_half_of_the_union_and_gone_below_half_of_the_place() -> None:
    halves = [at(6, {9: points(NEW_2)[:n] + points(OF_3)[:m]}) for n, m in ((5, 0), (4, 0), (10, 0), (0, 5), (0, 4))]
    each = [count_changes(PLACES, [one]) for one in halves]
    assert [one["found"][0] for one in each] == [1, 0, 1, 0, 0]
    assert [one["removed"][0] for one in each] == [2, 2, 2, 1, 2]


@pytest.mark.parametrize(
    ("instances", "n"),
    [
        ({1: points(OF_1), 2: points(NEW_2)}, 0),
        ({1: points(OF_1, OF_4)}, 1),  # two objects
        ({2: points(OLD_2, NEW_2)}, 1),  # one at both places
        ({1: points(OF_1) + points(OF_4)[:5]}, 1),
        ({1: points(OF_1) + points(OF_4)[:4]}, 0),
        ({1: points(OF_1, -1)}, 0),  # background is no object
    ],
)
def test_wrong_merge_covers_two_places(instances: Mapping[int, Sequence[int]], n: int) -> None:
    ordered = {key: sorted(own) for key, own in instances.items()}
    assert changes.wrong_merges(PLACES, at(6, ordered)).tolist() == [n, len(instances)]


def test_khronos_measures_of_a_map_that_never_removes() -> None:
    """Online: 3 of 3, 3 of 5 and 3 of 5 instances are there. 4D also asks the later maps about earlier frames, in
    which 3 of their 5 are there too. Both new places are seen in both later maps; 1 and then 2 places are left."""
    found = values([hoarder(n) for n in (2, 4, 6)])
    assert (found["ObjectPrecision"], found["ObjectRecall"]) == (9 / 13, 1)
    assert found["4D ObjectPrecision"] == (3 + 2 * 3 + 3 * 3) / (3 + 2 * 5 + 3 * 5)
    assert (found["AppearedF1"], found["DisappearedPrecision"] == found["DisappearedPrecision"]) == (1, False)
    assert found["DisappearedRecall"] == 0 and found["ChangeF1"] == 8 / (8 + 3)


def test_what_finds_no_partner_is_counted() -> None:
    """Not so by Khronos' default association: an instance at no object, and an object without an instance."""
    background = at(6, {1: points(OF_1), 7: points(-1)})
    nowhere = at(6, {1: points(OF_1), 7: []})
    for one, n_false in ((background, 0), (nowhere, 1)):
        assert changes.objects(PLACES, one, 25).tolist() == [1, n_false, 2]


def test_false_changes_are_counted() -> None:
    """Object 1 is covered and then lost: a false *disappeared*. It is seen, and covered only later: a false
    *appeared*."""
    lost = count_changes(PLACES, [perfect(2), at(6, {2: points(NEW_2), 4: points(OF_4)})])
    late = count_changes(PLACES, [at(2, {2: points(OLD_2), 3: points(OF_3)}), perfect(6)])
    names = [f"{name}{ratio}" for name in ("Appeared", "Disappeared") for ratio in ("Precision", "Recall")]
    assert [lost[name].tolist() for name in names] == [[2, 2], [2, 2], [2, 3], [2, 2]]
    assert [late[name].tolist() for name in names] == [[2, 3], [2, 2], [2, 2], [2, 2]]


def test_t_ap_needs_one_identity_in_all_stages() -> None:
    """Of the map that never removes, objects 1 and 4 match; 2 changes its id, and 3 stays: 2 of 5 ids are right, and
    AP is recall (1 + precision) / 2. With one id for both places of 2 it matches too, and with that of 3 gone."""
    values_of = [
        combine([count_stages(PLACES, stages, THRESHOLDS)], THRESHOLDS).ap
        for stages in (
            [hoarder(2), hoarder(6)],
            [perfect(2), at(6, {1: points(OF_1), 2: points(NEW_2), 3: points(OF_3), 4: points(OF_4)})],
        )
    ]
    assert values_of == pytest.approx([0.5 * (1 + 2 / 5) / 2, 0.75 * (1 + 3 / 4) / 2])
