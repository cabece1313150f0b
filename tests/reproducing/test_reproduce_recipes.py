"""Recipes: all printed figures and methods exist here; an invalid recipe is a one-line error with its place."""

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
def test_built_in_recipes_use_existing_methods_scenes_and_protocols(name: str) -> None:
    recipe = load_recipe(name)
    runs = asked_runs(recipe, recipe.experiments, RecipeRequest())
    assert {one for run in runs for one in run.experiments} == {one.name for one in recipe.experiments}
    assert all(run.methods and run.scenes and run.protocols for run in runs)


@pytest.mark.parametrize("name", recipe_names())
def test_each_printed_row_has_a_method_that_is_run_or_accepts_predictions(name: str) -> None:
    recipe = load_recipe(name)
    for experiment in recipe.experiments:
        (*_, methods) = (run.methods for run in asked_runs(recipe, [experiment], RecipeRequest()))
        for figure in experiment.printed():
            method = method_of_row(experiment, figure.method, figure.row)
            assert method in methods or figure.method in experiment.predictions, figure


def test_opensu3d_recipe_has_every_figure_of_its_paper() -> None:
    printed = [figure for one in load_recipe("opensu3d").experiments for figure in one.printed()]
    assert [figure for figure in published() if figure.table is not None and figure not in printed] == []
    assert figures_of(table="I") == printed[:9]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("methods =", "method ="), "experiment 1 method: unknown key; did you mean 'methods'?"),
        (("schema = 1", "schema = 2"), "schema"),
        (('table = "III"', 'table = "IX"'), "experiment a: published.toml has no figure with table = IX"),
        (('table = "III"', 'tabel = "III"'), "experiment a: figures have no 'tabel'; did you mean 'table'?"),
        (('methods = ["opensu3d"]', ""), "has no methods, vary or predictions, so there is nothing to do"),
        (("[[experiment]]", "[experiment"), "is not valid TOML"),
    ],
)
def test_invalid_recipe_is_a_one_line_error(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(OWN)
    assert load_recipe(str(file)).experiments[0].printed() == figures_of(table="III")
    file.write_text(OWN.replace(*change))
    with pytest.raises(ConfigError) as raised:
        load_recipe(str(file))
    assert str(raised.value).startswith("mine.toml: ") and says in str(raised.value)


def test_given_scenes_replace_those_of_their_dataset_and_leave_out_other_datasets() -> None:
    recipe = load_recipe("opensu3d")
    asked = RecipeRequest(scenes={"replica": ("replica/bedroom0",)})
    runs = asked_runs(recipe, recipe.chosen(["III", "V"]), asked)
    assert {(run.dataset, run.scenes) for run in runs} == {("replica", ("replica/bedroom0",))}
    with pytest.raises(ConfigError, match="--scenes: no requested table uses the dataset 'homes'"):
        asked_runs(recipe, recipe.chosen(["III"]), RecipeRequest(scenes={"homes": ("homes/test0",)}))
