"""The original evaluation of each protocol: a complete table, facts shown everywhere, and its cases."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import synthetic_boxes
import synthetic_instances
import synthetic_maps
import synthetic_objects
import synthetic_points
import synthetic_queries
from places import CASES, ROOT

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.metrics.protocols import loading as module
from su3d_bench.metrics.protocols.loading import load_protocol, original_of, protocol_names, rules_file
from su3d_bench.metrics.scoring import combine

WHOLE = """
[original]
code = "a/b"
commit = "0123abc"
files = ["eval.py"]
licence = "none stated"
data = "nobody's"
compared = "AP"
"""


@pytest.mark.parametrize("name", protocol_names())
def test_every_protocol_states_its_original_and_its_cases_exist(name: str) -> None:
    stated = original_of(name)
    assert stated is not None
    for pattern in stated.original.cases:
        assert any(ROOT.glob(pattern)), pattern


def test_comparison_with_more_than_the_stored_cases_has_its_program() -> None:
    words = [sys.executable, str(ROOT / "benchmarks"), "compare_originals"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    listed = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    programs = {name.strip(",") for line in listed.stdout.splitlines() for name in line.split()[:-1]}
    stated = {name: original_of(name) for name in protocol_names()}
    many = {name for name, one in stated.items() if one is not None and one.base is None and one.original.problems > 30}
    assert len(many) > 20 and many <= programs


def own(folder: Path, table: str, base: str = "scannet-instance") -> str:
    path = folder / "mine.toml"
    path.write_text(f'extends = "{base}"\nname = "mine"\n{table}')
    return str(path)


def test_file_that_extends_another_inherits_its_original(tmp_path: Path) -> None:
    taken = original_of(own(tmp_path, ""))
    assert taken is not None and taken.base == "scannet-instance"
    assert taken.original.code == "ScanNet/ScanNet" and taken.facts["original of"].startswith("scannet-instance")
    stated = original_of(own(tmp_path, WHOLE))
    assert stated is not None and (stated.base, stated.original.code) == (None, "a/b")
    assert stated.original.cases == () and stated.original.problems == 0  # inherited as a whole or not at all


def test_original_table_changes_no_rule(tmp_path: Path) -> None:
    with_one, without = load_protocol(own(tmp_path, WHOLE)).digest, load_protocol(own(tmp_path, "")).digest
    assert with_one == without


def test_custom_rules_need_no_original_table_and_built_in_ones_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = rules_file("rooms-instance").read_text().partition("[original]")[0]
    mine = tmp_path / "mine.toml"
    mine.write_text(text.replace('name = "rooms-instance"', 'name = "mine"'))
    assert original_of(str(mine)) is None
    assert main(["protocols", "show", str(mine)]) == 0
    assert f"{'original':<28} not said" in capsys.readouterr().out
    monkeypatch.setattr(module, "RULES", tmp_path)
    with pytest.raises(ConfigError, match=r"the table \[original\] is missing"):
        original_of(str(mine))


REFUSED = [
    (WHOLE.replace('licence = "none stated"\n', ""), "original: give code, commit, files, licence"),
    (WHOLE.replace('data = "nobody\'s"\n', ""), "the key 'original.data' is missing"),
    (WHOLE + 'none = "ours"\n', "original: give code, commit, files, licence"),
    (WHOLE + "largest_difference = 0.0\n", "original: largest_difference: give it if, and only if"),
    (WHOLE + 'license = "MIT"\n', "unknown key 'original.license'; did you mean 'licence'?"),
    (WHOLE.replace("0123abc", "main"), "original.commit: string should match"),
    (WHOLE.replace('"a/b"', '"https://a/b"'), "original.code: string should match"),
    ('original = "mine"\n', "original must be a table"),
]


@pytest.mark.parametrize(("table", "message"), REFUSED)
def test_incomplete_original_table_is_one_line(
    table: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["protocols", "show", own(tmp_path, table)]) == 2
    error = capsys.readouterr().err
    assert message in error and "mine.toml" in error and error.count("\n") == 1


# ---- results of the original instance evaluators on the same generated problems

FOUND = json.loads((CASES / "originals_instance.json").read_text())
LAST_BITS = dict.fromkeys(("class-agnostic-maskclustering", "opensun3d-challenge"), 1.2e-16)


@pytest.mark.parametrize(("name", "number"), [(name, k) for name in FOUND["answers"] for k in FOUND["answers"][name]])
def test_generated_instance_problem_equals_the_original(name: str, number: str) -> None:
    rules, problem = load_protocol(name), FOUND["problems"][number]
    is_text_only = any(synthetic_instances.is_text_only(rules, scene) for scene in problem)
    ways = [] if is_text_only else [[synthetic_instances.scored(rules, scene) for scene in problem]]
    if "order" in problem[0]:
        ways.append(synthetic_instances.scored_text(rules, problem))
    answer = np.array(FOUND["answers"][name][number], float)  # null is undefined
    for scores in ways:
        found = combine(rules, dict(zip("abc", scores, strict=False)), with_intervals=False).metrics
        ours = [found[key] for key in ("AP", "AP50", "AP25")]
        np.testing.assert_allclose(ours, answer, rtol=0, atol=LAST_BITS.get(name, 0))


# ---- and of one class per point

ROUNDING = {"replica-conceptgraphs-ex6": 6e-8}  # the original's ratios are float32
OF_POINTS = json.loads((CASES / "originals_semantic.json").read_text())


@pytest.mark.parametrize(("name", "number"), [(name, k) for name in OF_POINTS for k in range(len(OF_POINTS[name]))])
def test_generated_point_problem_equals_the_original(name: str, number: int) -> None:
    rules, problem = load_protocol(name), OF_POINTS[name][number]
    read = synthetic_objects.scored if rules.metric == "ovo" else synthetic_points.scored
    scores = {str(s): read(rules, scene) for s, scene in enumerate(problem["scenes"])}
    found = combine(rules, scores, with_intervals=False)
    if rules.metric == "ovo":  # with the means of thirds, NaN if no class of one is true or predicted
        values = dict(found.metrics) | {
            f"{group} {key}": value for group, row in found.groups.items() for key, value in row.items()
        }
        wanted = {key: np.nan if value is None else value for key, value in problem["answer"].items()}
        assert {key: values[key] for key in wanted} == pytest.approx(wanted, rel=0, abs=2.3e-16, nan_ok=True)
        return
    answer = problem["answer"]
    if name in ("scannet-semantic", "scannet200-semantic"):  # the IoU of each true or predicted class
        assert {of_class: row["IoU"] for of_class, row in found.per_class.items() if row["IoU"] == row["IoU"]} == answer
        return
    each = answer if isinstance(answer, list) else [answer]
    rows = [found.per_scene[scene] for scene in scores] if isinstance(answer, list) else [found.metrics]
    for row, of_original in zip(rows, each, strict=True):
        assert {key: row[key] for key in of_original} == pytest.approx(
            of_original, rel=0, abs=ROUNDING.get(name, 2.3e-16)
        )


# ---- of maps and meshes in files, with ties

OF_MAPS = json.loads((CASES / "originals_maps.json").read_text())


@pytest.mark.parametrize(("name", "number"), [(name, k) for name in OF_MAPS for k in range(len(OF_MAPS[name]))])
def test_generated_files_of_maps_score_as_in_the_original(name: str, number: int, tmp_path: Path) -> None:
    problem = OF_MAPS[name][number]
    ours = synthetic_maps.values_of(load_protocol(name), problem["scenes"], tmp_path)
    np.testing.assert_allclose(ours, np.array(problem["answer"], float), rtol=0, atol=1e-15)


# ---- of boxes, and of text queries

OF_BOXES = json.loads((CASES / "boxes01_votenet.json").read_text())["problems"]
OF_QUERIES = json.loads((CASES / "queries01_scannet.json").read_text())["problems"]
OF_A_CLASS = ("AP25", "recall25", "AP50", "recall50")


@pytest.mark.parametrize("number", range(len(OF_BOXES)))
def test_generated_box_problem_equals_votenet(number: int) -> None:
    rules, problem = load_protocol("replica-boxes"), OF_BOXES[number]
    scores = {str(s): synthetic_boxes.scored(rules, scene) for s, scene in enumerate(problem["scenes"])}
    found = combine(rules, scores, with_intervals=False)
    expected = np.array(problem["answer"], float).reshape(len(OF_A_CLASS), -1)  # null: no true box, or no mean
    for key, (*of_slots, mean) in zip(OF_A_CLASS, expected.tolist(), strict=True):
        ours = [found.per_class[name][key] for _, name in synthetic_boxes.names_of(rules).values()]
        np.testing.assert_allclose(ours, of_slots, rtol=0, atol=2.3e-16)
        assert np.isnan(mean) or found.metrics[key] == pytest.approx(mean, rel=0, abs=2.3e-16)


@pytest.mark.parametrize("number", range(len(OF_QUERIES)))
def test_generated_text_query_problem_equals_the_scannet_script(number: int) -> None:
    problem = OF_QUERIES[number]
    found = synthetic_queries.scored(load_protocol("query-ap"), problem["scenes"])
    ours = [found.ap, found.ap50, found.ap25, *found.table[0]]
    np.testing.assert_allclose(ours, np.array(problem["answer"], float), rtol=0, atol=2.3e-16)
