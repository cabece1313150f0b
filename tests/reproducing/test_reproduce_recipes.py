"""Recipes: each finds its printed figures and methods here; a wrong one is one line that says where and what."""

from __future__ import annotations

from pathlib import Path

import pytest

from su3d_bench.core.errors import ConfigError
from su3d_bench.reports.tables.paper import figures_of, published
from su3d_bench.reproducing.recipe import RecipeRequest, asked_runs, load_recipe, method_of_row, recipe_names

OWN = """
schema = 1
name = "mine"
title = "Mine"
[[experiment]]
name = "a"
title = "A"
methods = ["opensu3d"]
scenes = ["replica/room0"]
protocols = ["replica-openmask3d"]
figures = [{ table = "III" }]
"""


@pytest.mark.parametrize("name", recipe_names())
def test_each_recipe_of_the_program_asks_for_runs_of_methods_scenes_and_protocols_that_there_are(name: str) -> None:
    recipe = load_recipe(name)
    runs = asked_runs(recipe, recipe.experiments, RecipeRequest())
    assert {one for run in runs for one in run.experiments} == {one.name for one in recipe.experiments}
    assert all(run.methods and run.scenes and run.protocols for run in runs)


@pytest.mark.parametrize("name", recipe_names())
def test_each_printed_row_is_of_a_method_that_is_run_or_of_predictions_that_are_taken(name: str) -> None:
    recipe = load_recipe(name)
    for experiment in recipe.experiments:
        (*_, methods) = (run.methods for run in asked_runs(recipe, [experiment], RecipeRequest()))
        for figure in experiment.printed():
            method = method_of_row(experiment, figure.method, figure.row)
            assert method in methods or figure.method in experiment.predictions, figure


def test_opensu3ds_recipe_has_every_figure_that_is_printed_in_its_paper() -> None:
    printed = [figure for one in load_recipe("opensu3d").experiments for figure in one.printed()]
    assert [figure for figure in published() if figure.table is not None and figure not in printed] == []
    assert figures_of(table="I") == printed[:9]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("methods =", "method ="), "experiment 1 method: unknown key; did you mean 'methods'?"),
        (("schema = 1", "schema = 2"), "schema"),
        (('table = "III"', 'table = "IX"'), "experiment a: published.toml holds no figure of table = IX"),
        (('table = "III"', 'tabel = "III"'), "experiment a: figures have no 'tabel'; did you mean 'table'?"),
        (('methods = ["opensu3d"]', ""), "names no methods, no vary and no predictions"),
        (("[[experiment]]", "[experiment"), "is no TOML"),
    ],
)
def test_a_wrong_recipe_is_one_line(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(OWN)
    assert load_recipe(str(file)).experiments[0].printed() == figures_of(table="III")
    file.write_text(OWN.replace(*change))
    with pytest.raises(ConfigError) as raised:
        load_recipe(str(file))
    assert str(raised.value).startswith("mine.toml: ") and says in str(raised.value)
