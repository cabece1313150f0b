"""Settings drawn from the schemas of every method, dataset and of perception: taken, or declined as ``ConfigError``."""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fuzz_mutations import TEXTS, VALUES
from fuzzing import BadMessage, fault_of_message
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel
from pydantic_core import PydanticUndefined
from test_fuzz_cli import EXAMPLES

from su3d_bench.core.config import Setting, Settings, check_keys, flatten, read_file, resolve, write_toml
from su3d_bench.core.errors import Su3dError
from su3d_bench.core.registry import DATASETS, METHODS, load
from su3d_bench.perception.profiles import PerceptionConfig

SECTIONS: dict[tuple[str, ...], type[BaseModel]] = {
    **{("method", name): load("method", name).Config for name in METHODS},
    **{("dataset", name): load("dataset", name).Options for name in DATASETS},
    ("perception",): PerceptionConfig,
}
QUIET = settings(
    max_examples=2 * EXAMPLES,
    deadline=None,
    derandomize=EXAMPLES == 6,
    database=None,
    suppress_health_check=list(HealthCheck),
)
ODD = st.sampled_from([one for one in VALUES if one is not None]) | st.sampled_from(TEXTS) | st.floats() | st.integers()


def written_values(annotation: Any) -> st.SearchStrategy[Any]:
    """Values of the kind that a field asks for, as TOML has them."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return written_values(parts[0])
    if origin is typing.Literal:
        return st.sampled_from(parts)
    if origin in (typing.Union, types.UnionType):
        return st.one_of(*(written_values(one) for one in parts if one is not types.NoneType))
    if origin in (tuple, list, set, frozenset):
        inner = [written_values(one) for one in parts if one is not Ellipsis] or [ODD]
        return st.lists(st.one_of(*inner), max_size=5)
    if origin is dict:
        return st.dictionaries(st.text(max_size=5), written_values(parts[1]), max_size=3)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return tables(annotation)
    simple = {
        bool: st.booleans(),
        int: st.integers(-5, 200) | st.integers(),
        float: st.floats(),
        str: st.text(max_size=9),
    }
    return simple.get(annotation, st.text(max_size=9))


def tables(model: type[BaseModel]) -> st.SearchStrategy[dict[str, Any]]:
    """A few fields of a model, most of the right kind, some not, and sometimes a key that it does not know."""

    @st.composite
    def draw_table(draw: st.DrawFn) -> dict[str, Any]:
        names = draw(st.lists(st.sampled_from(sorted(model.model_fields)), max_size=4, unique=True))
        found = {}
        for name in names:
            field = model.model_fields[name]
            kind = draw(st.sampled_from(["default", "right", "right", "right", "odd"]))
            default = field.get_default(call_default_factory=True) if not field.is_required() else PydanticUndefined
            if kind == "default" and isinstance(default, bool | int | float | str):
                found[name] = default
            else:
                found[name] = draw(ODD if kind == "odd" else written_values(field.annotation))
        if draw(st.integers(0, 9)) == 0:
            found[draw(st.text(max_size=9))] = draw(ODD)
        return found

    return draw_table() if model.model_fields else st.just({})


@contextmanager
def declined() -> Iterator[None]:
    """What stands in the block may be refused, in one line."""
    try:
        yield
    except Su3dError as error:
        if (fault := fault_of_message(str(error))) is not None:
            raise BadMessage(fault) from error


def assert_finite(value: Any) -> None:
    """A setting that was taken is no NaN: none of ours means anything by it."""
    if isinstance(value, dict):
        for one in value.values():
            assert_finite(one)
    elif isinstance(value, list | tuple):
        for one in value:
            assert_finite(one)
    else:
        assert not (isinstance(value, float) and math.isnan(value))


@pytest.mark.parametrize("section", SECTIONS, ids=".".join)
@QUIET
@given(data=st.data())
def test_settings_are_taken_or_declined_in_one_line(section: tuple[str, ...], data: st.DataObject) -> None:
    model = SECTIONS[section]
    leaves = flatten(data.draw(tables(model)))
    given_settings = Settings(tuple(Setting((*section, *path), value, "a.toml:1") for path, value in leaves))
    with declined():
        check_keys(given_settings)
        taken = resolve(given_settings, section, model)
        assert_finite(taken.model_dump())
        assert resolve(given_settings, section, model) == taken
        if section[0] == "method":
            load("method", section[1])(taken)


SECTION_AND_TABLE = st.sampled_from(sorted(SECTIONS)).flatmap(
    lambda one: st.tuples(st.just(one), tables(SECTIONS[one]))
)


@QUIET
@given(drawn=SECTION_AND_TABLE)
def test_settings_written_as_toml_are_read_again_or_declined(
    drawn: tuple[tuple[str, ...], dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    section, table = drawn
    path = tmp_path_factory.getbasetemp() / "drawn.toml"
    try:
        path.write_text(write_toml([((*section, *key), value, "drawn") for key, value in flatten(table)]), "utf-8")
    except (TypeError, UnicodeEncodeError):  # what TOML has no form for: tables in lists, lone surrogates
        return
    with declined():
        read = read_file(path)
        assert all(entry.path[: len(section)] == section for entry in read.entries)
