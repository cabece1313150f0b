"""``protocols texts`` and ``protocols show --list-texts``: encoded texts name features exactly as the run does."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from su3d_bench.cli.main import main
from su3d_bench.evaluation.result import KEYS
from su3d_bench.evaluation.texts import GivenTextEncoder, candidate_names, read_text_features
from su3d_bench.metrics.matching.labelling import text_features
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.perception.embedded.encoder import EmbeddedEncoder

TWO_PROMPTS = "replica-hovsg"


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SU3D_MODELS", str(tmp_path / "models"))


def make(protocol: str, out: str, *more: str) -> int:
    return main(["protocols", "texts", "--protocol", protocol, "--encoder", "embedded", "--out", out, *more])


def test_encoded_texts_reproduce_the_numbers_of_the_run(
    rooms_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SU3D_DATA", str(rooms_data))
    monkeypatch.setenv("SU3D_CACHE", str(tmp_path / "cache"))
    protocols = ["rooms-semantic", "rooms-instance"]
    words = ["--scenes", "rooms/bathroom0", "--methods", "opensu3d", "--stride", "200", "--jobs", "1"]
    assert main(["run", *words, "--protocols", *protocols, "--no-pictures", "--quiet", "--out", "out"]) == 0
    own = json.loads(Path("out/metrics.json").read_text())["results"]
    for name in protocols:
        assert make(name, f"{name}.npz") == 0
        words = ["evaluate", "out/scenes/rooms.bathroom0/opensu3d", "--dataset", "rooms", "--quiet"]
        words += ["--protocols", name]
        assert main([*words, "--json=own.json"]) == 0
        assert main([*words, "--text-features", f"{name}.npz", "--json=texts.json"]) == 0
        assert Path("texts.json").read_bytes() == Path("own.json").read_bytes()
        found = json.loads(Path("texts.json").read_text())["protocols"][name]["metrics"]
        of_run = next(entry["result"]["metrics"] for entry in own if entry["protocol"] == name)
        assert [found[KEYS[key]] for key in load_protocol(name).headline] == [
            of_run[key] for key in load_protocol(name).headline
        ]


def test_mean_over_several_prompts_equals_that_of_the_encoder() -> None:
    assert make(TWO_PROMPTS, "texts.npz") == 0
    rules, encoder, given = load_protocol(TWO_PROMPTS), EmbeddedEncoder(), read_text_features(Path("texts.npz"))
    assert given is not None
    assert given.missing(rules) == []
    names, features = candidate_names(rules), np.ones((1, encoder.dim), np.float32)
    assert len(given.names) == 2 * len(names)
    expected = text_features(rules, names, features, encoder)
    assert np.array_equal(text_features(rules, names, features, GivenTextEncoder(given, rules)), expected)
    assert given.encoder == encoder.name


def test_texts_of_a_protocol_are_listed_one_per_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["protocols", "show", TWO_PROMPTS, "--list-texts"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["background", "There is the background in the scene."]
    assert main(["protocols", "show", TWO_PROMPTS, "--list-texts", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert (value["protocol"], value["encoder"]) == (TWO_PROMPTS, "ViT-H-14/laion2b_s32b_b79k")
    assert value["names"][0] == {"name": "background", "texts": lines[:2]}
    assert [text for entry in value["names"] for text in entry["texts"]] == lines
    assert main(["protocols", "texts", "--protocol", TWO_PROMPTS, "--encoder", "embedded", "--out", "t.npz"]) == 0
    with np.load("t.npz") as made:
        assert made["names"].tolist() == lines


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("q.txt", "a place to sit\nsomething to eat at\na place to sit\n"),
        ("q.csv", 'scene,text,objects\nroom0,a place to sit,1\nroom1,"something to eat at",\n'),
        ("q.toml", '[[query]]\nscene = "r"\ntext = "a place to sit"\nobjects = []\n'
                   '[[query]]\nscene = "r"\ntext = "something to eat at"\nobjects = [3]\n'),
        ("q.json", '{"synonyms": {"a place to sit": [1], "something to eat at": ["2"]}}'),
    ],
)  # fmt: skip
def test_queries_are_encoded_from_every_format(name: str, content: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path(name).write_text(content)
    assert make("query-ap", "texts.npz", "--queries", name) == 0
    assert ("--queries" in capsys.readouterr().err) == (name in ("q.csv", "q.toml"))
    with np.load("texts.npz") as made:
        assert made["names"].tolist() == ["a place to sit", "something to eat at"]
        expected = EmbeddedEncoder().encode_texts(made["names"].tolist())
        assert np.array_equal(made["features"], expected)
    assert main(["protocols", "show", "query-ap", "--list-texts", "--queries", name]) == 0
    assert capsys.readouterr().out == "a place to sit\nsomething to eat at\n"


REFUSED = [
    (["--protocol", "rooms-semantic"], "protocol 'rooms-semantic' has no encoder; choose one with --encoder: embedded"),
    (["--protocol", "rooms-semantic", "--encoder", "embeded"], "unknown encoder 'embeded'; did you mean 'embedded'?"),
    (["--protocol", "class-agnostic-open3dis"], "does not compare features with texts; there is nothing to encode"),
    (["--protocol", "rooms-semantic", "--queries", "q.txt"], "uses its classes as texts; remove --queries"),
    (["--protocol", "query-ap", "--queries", "q.txt", "--encoder", "embedded"], "q.txt: is missing"),
    (["--protocol", "rooms-semantic", "--encoder", "embedded", "--out", "t.txt"], "expected a file that ends in .npz"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "message"), REFUSED)
def test_invalid_texts_request_is_a_one_line_error(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["protocols", "texts", "--out", "texts.npz", *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(Path().glob("texts*"))
