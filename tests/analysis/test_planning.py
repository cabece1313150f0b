"""Power analysis and comparison of two methods with one or several seeds."""

from __future__ import annotations

import json
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from painted_runs import COLLECTOR, consistent, painted_run
from scored_room import noisy_scores

from su3d_bench.analysis.comparison import compare, plan
from su3d_bench.cli.main import main
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.scoring import combine, pack_scores
from su3d_bench.numerics.statistics import scenes_needed, sign_flip_test, variance_of
from su3d_bench.store.run_folder import RunFolder

PROTOCOLS = ("rooms-semantic", "rooms-instance")
METHODS = ("collector", "collector@drop=1")
N_SCENES = 3


@cache
def scores_of(name: str) -> list[SceneScore]:
    """One score per scene, method and run, all different."""
    return list(noisy_scores(name, 6 * N_SCENES).values())


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``seed-0`` to ``seed-2``: the same two methods, with different counts in every scene, method and run."""
    folder = tmp_path_factory.mktemp("plans")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        methods = (COLLECTOR, f"{COLLECTOR}@drop=1")
        painted_run(Path("seed-0"), "--quiet", "--seed", "0", methods=methods, scenes="abc")
        for seed in (1, 2):
            shutil.copytree("seed-0", f"seed-{seed}")
            for name, text in (("run.json", '"seed": {}'), ("run.toml", "\nseed = {}")):
                file = Path(f"seed-{seed}", name)
                assert text.format(0) in file.read_text()
                file.write_text(file.read_text().replace(text.format(0), text.format(seed), 1))
    made = {name: scores_of(name) for name in PROTOCOLS}
    for k in range(6):
        for s, scene in enumerate("abc"):
            packed = pack_scores({name: scores[N_SCENES * k + s] for name, scores in made.items()})
            RunFolder(folder / f"seed-{k // 2}").job(f"painted/{scene}", METHODS[k % 2]).counts.write_bytes(packed)
    for seed in range(3):
        consistent(folder / f"seed-{seed}")
    return folder


@pytest.fixture(autouse=True)
def _in_folder(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)


def pseudo_values_of(name: str, metric: str, seed: int) -> list[float]:
    """Pseudo-values of the difference between the two methods in a run, from the numbers without each scene."""
    scores = scores_of(name)
    rules = load_protocol(name)

    def value(method: int, left_out: int | None) -> float:
        first = N_SCENES * (2 * seed + method)
        own = {str(s): scores[first + s] for s in range(N_SCENES) if s != left_out}
        return combine(rules, own).metrics[metric]

    whole = value(1, None) - value(0, None)
    return [N_SCENES * whole - (N_SCENES - 1) * (value(1, s) - value(0, s)) for s in range(N_SCENES)]


@pytest.mark.parametrize("n_seeds", [1, 3])
def test_needed_scenes_follow_from_the_pseudo_values_of_the_runs(n_seeds: int) -> None:
    found = plan([Path(f"seed-{seed}") for seed in range(n_seeds)], points=[5.0, 20.0])
    assert (found.left, found.right, found.seeds) == (*METHODS, tuple(range(n_seeds)))
    for protocol, metric in (("rooms-semantic", "mAcc"), ("rooms-instance", "AP50")):
        one = found.protocols[protocol][metric]
        variance = variance_of(np.array([pseudo_values_of(protocol, metric, seed) for seed in range(n_seeds)]))
        assert one.variance is not None
        assert one.variance.of_scenes == pytest.approx(variance.of_scenes, abs=1e-12)
        assert one.variance.of_rest == pytest.approx(variance.of_rest, abs=1e-12)
        assert (one.variance.of_seeds is None) == (n_seeds == 1)
        for need in one.needs:
            assert need.n_scenes == scenes_needed(variance, need.points / 100, need.n_seeds)
            if None not in (need.low, need.n_scenes, need.high):
                assert need.low <= need.n_scenes <= need.high  # type: ignore[operator]
        assert {need.n_seeds for need in one.needs} == ({1} if n_seeds == 1 else {1, 2, 3, 5, 10})


def test_power_command_prints_a_table_or_json(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["report", "power", "seed-0", "seed-1", "--methods", *METHODS, "--points", "10"]
    words += ["--protocols", "rooms-instance"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "| AP " in text and "10 points" in text and "seed 0, 1" in text
    assert "two seeds: no interval" in text
    assert "intervals from fewer than 10 scenes are unreliable (here: 3)" in text
    assert main([*words, "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["protocols"]) == ["rooms-instance"]
    assert main(["report", "power", "seed-0"]) == 0
    assert "the effect of seeds on the difference is unknown" in capsys.readouterr().out


# comparisons of several seeds


def values_of(name: str, metric: str, seed: int, method: int) -> tuple[float, list[float]]:
    """The value over all scenes, and that of each scene."""
    first = N_SCENES * (2 * seed + method)
    own = {scene: scores_of(name)[first + s] for s, scene in enumerate("abc")}
    result = combine(load_protocol(name), own)
    return result.metrics[metric], [result.per_scene[scene][metric] for scene in "abc"]


@pytest.mark.parametrize(("protocol", "metric"), [("rooms-semantic", "mAcc"), ("rooms-instance", "AP50")])
def test_side_of_several_seeds_is_their_mean_with_standard_deviation(protocol: str, metric: str) -> None:
    comparison = compare("seed-0,seed-1,seed-2:collector", "seed-0,seed-2:collector@drop=1")
    found = next(one for one in comparison.protocols if one.protocol == protocol).metrics[metric]
    sides = [[values_of(protocol, metric, seed, k) for seed in seeds] for k, seeds in enumerate([(0, 1, 2), (0, 2)])]
    whole = [[value for value, _ in side] for side in sides]
    alone = [np.mean([scenes for _, scenes in side], axis=0) for side in sides]
    assert comparison.seeds == ((0, 1, 2), (0, 2))
    assert (found.left, found.right) == pytest.approx([np.mean(side) for side in whole])
    assert found.deviations_of_seeds == pytest.approx([np.std(side, ddof=1) for side in whole])
    assert list(found.per_scene.values()) == pytest.approx(list(alone[1] - alone[0]))
    assert found.test == sign_flip_test(alone[1] - alone[0])
