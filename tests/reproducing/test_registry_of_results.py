"""A registry: comparable rows share one ranking, others are rejected with what, where and what to do."""

from __future__ import annotations

import base64
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from painted_runs import consistent
from registry_bundles import edit_record, painted_bundle, read_bundle, rewrite_bundle

from su3d_bench.cli.main import main
from su3d_bench.core.errors import ConfigError
from su3d_bench.reproducing.bundle import bundle_runs
from su3d_bench.reproducing.registry import ModelWeights, conflict_with, read_registry, rows_of_bundle

STRUCK = "<img src=x onerror=window.struck=1></script><script>window.struck=1</script>"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two bundles with different variants on the same scenes."""
    folder = tmp_path_factory.mktemp("registry")
    painted_bundle(folder, "ann", ["@drop=1", "@noise_m=0.3"], printed=f"my own photos {STRUCK}")
    painted_bundle(folder, "bob", [""])
    return folder


@pytest.fixture
def registry(made: Path, tmp_path: Path) -> Path:
    (tmp_path / "registry" / "bundles").mkdir(parents=True)
    for name in ("ann", "bob"):
        shutil.copy(made / f"{name}.zip", tmp_path / "registry" / "bundles")
    return tmp_path / "registry"


def test_rows_of_several_bundles_share_one_ranking_per_protocol_best_first(registry: Path) -> None:
    found = read_registry(registry)
    assert found.refused == () and found.n_bundles == 2
    assert [board[0].protocol for board in found.boards] == ["rooms-instance", "rooms-semantic"]
    for board in found.boards:
        values = [row.values[0] or 0.0 for row in board]
        assert values == sorted(values, reverse=True)
        assert {row.bundle.name for row in board} == {"ann", "bob"}
        assert all(row.ranks is not None for row in board)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"version": 2', '"version": 3', "was scored under rooms-semantic version 3, now it is version 2"),
        ('"is_partial": false', '"is_partial": true', "is_partial is True and False"),
    ],
)
def test_run_that_cannot_be_ranked_is_excluded_with_a_reason(registry: Path, old: str, new: str, says: str) -> None:
    files, manifest = read_bundle(registry / "bundles" / "bob.zip")
    edit_record(files, "runs/bob/run.json", old, new)
    rewrite_bundle(registry / "bundles" / "bob.zip", files, manifest)
    found = read_registry(registry)
    assert any(says in one.reason for one in found.refused)
    assert main(["dev", "registry", "build", str(registry), "--out", str(registry.parent / "site")]) == 1


@pytest.mark.parametrize(
    ("digest", "says"),
    [
        ("0" * 64, "its data of painted/a have the digest 000000000000, those of collector@drop=1 in ann.zip "),
        (None, "the name is taken by collector@drop=1 in ann.zip on the same scenes; give the variant"),
    ],
)
def test_rows_with_other_data_or_duplicate_methods_are_rejected(
    made: Path, registry: Path, tmp_path: Path, digest: str | None, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Path(shutil.copytree(made / "runs" / "ann", tmp_path / "dan"))
    record = json.loads((run / "run.json").read_text())
    record["data_digests"]["painted/a"] = digest or record["data_digests"]["painted/a"]
    (run / "run.json").write_text(json.dumps(record))
    bundle = tmp_path / "dan.zip"
    bundle_runs(bundle, [consistent(run)])
    assert main(["dev", "registry", "add", str(bundle), "--registry", str(registry)]) == 1
    assert "dan.zip: rejected: " in (printed := capsys.readouterr().out) and says in printed
    assert sorted(path.stem for path in (registry / "bundles").iterdir()) == ["ann", "bob"]


def test_features_of_two_encoders_conflict_if_the_protocol_requires_one(registry: Path) -> None:
    rows, _ = rows_of_bundle(registry / "bundles" / "ann.zip")
    one = replace(rows[0], protocol="replica-openmask3d", method="other", encoder="ViT-L-14-336/openai")
    other = replace(one, method="mine", encoder="su3d-embedded")
    assert "its features are from the encoder su3d-embedded, those of other in ann.zip from" in (
        conflict_with(other, [one]) or ""
    )
    assert conflict_with(replace(other, encoder=None), [one]) is None, "the method names its instances itself"
    free = [replace(row, protocol="rooms-instance") for row in (other, one)]
    assert conflict_with(free[0], free[1:]) is None, "the protocol does not require an encoder"
    weights = [(ModelWeights("clip-vit-l-14-336", "", (("model.safetensors", sha * 64),)),) for sha in "ab"]
    same = replace(other, encoder=one.encoder, weights=weights[0])
    assert "its weights of clip-vit-l-14-336 differ from those of" in (
        conflict_with(same, [replace(one, weights=weights[1])]) or ""
    )
    assert conflict_with(same, [replace(one, weights=weights[0])]) is None


def test_a_method_may_have_one_row_per_rate_of_a_real_time_run(registry: Path) -> None:
    (row, *_), _ = rows_of_bundle(registry / "bundles" / "bob.zip")
    assert row.costs["saved_mib"] and row.costs["peak_mib"] and row.costs["rate_hz"] is None
    other = replace(row, costs={**row.costs, "rate_hz": 5.0})
    assert conflict_with(other, [row]) is None
    assert "the name is taken by" in (conflict_with(other, [other]) or "")


def test_link_of_a_bundle_is_an_https_address(made: Path, registry: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--link 'javascript:1': expected an address that starts with https://"):
        bundle_runs(tmp_path / "x.zip", [made / "runs" / "bob"], link="javascript:1")
    files, manifest = read_bundle(registry / "bundles" / "bob.zip")
    rewrite_bundle(registry / "bundles" / "bob.zip", files, {**manifest, "link": "javascript:1"})
    (refused,) = read_registry(registry).refused
    assert refused.run == "bob.zip" and "link" in refused.reason


def test_site_has_one_page_per_method_and_scene_and_escapes_texts_of_bundles(
    registry: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["dev", "registry", "build", str(registry), "--out", str(tmp_path / "site"), "--title", STRUCK]
    assert main([*words, "--bundle-url", "https://example.org/b"]) == 0
    pages = sorted(path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.html"))
    assert len(pages) == 1 + 3 + 3
    for page in pages:
        text = (tmp_path / "site" / page).read_text(encoding="utf-8")
        assert "<img" not in text and "script-src 'sha256-" in text.replace("&#39;", "'")
    value = json.loads((tmp_path / "site" / "registry.json").read_text())
    bundle = value["boards"][0]["rows"][0]["bundle"]
    assert bundle["address"] == f"https://example.org/b/{bundle['file']}" and len(bundle["sha256"]) == 64
    rows = {row["bundle"]["file"]: row for row in value["boards"][0]["rows"]}
    assert (rows["ann.zip"]["authors"], rows["bob.zip"]["authors"]) == (f"my own photos {STRUCK}", "not stated")
    assert (rows["ann.zip"]["link"], rows["bob.zip"]["link"]) == ("https://example.org/method", "")
    for row in rows.values():
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", row["date"])
        assert base64.b64decode(value["pictures"][row["picture"]]).startswith(b"\x89PNG")
    before = {page: (tmp_path / "site" / page).read_bytes() for page in pages}
    assert main([*words, "--bundle-url", "https://example.org/b"]) == 0
    assert {page: (tmp_path / "site" / page).read_bytes() for page in pages} == before, "the same bytes again"
    (registry / "bundles" / "ann.zip").unlink()
    assert main(words) == 0
    assert len([*(tmp_path / "site" / "methods").iterdir()]) == 1, "pages of removed methods are deleted"
