"""The table of sources, compared with the model catalogue."""

from __future__ import annotations

import pytest

from su3d_bench.fetching.sources import built_in, check_address
from su3d_bench.perception.models.catalogue import MODELS


def test_sources_of_models_match_the_catalogue_names() -> None:
    assert {source.name for source in built_in().of("models")} == set(MODELS)


@pytest.mark.parametrize("name", list(MODELS))
def test_source_facts_match_the_model_catalogue(name: str) -> None:
    source, form = built_in().named(name), MODELS[name].fetched
    assert source.licence.name == MODELS[name].licence
    assert source.n_bytes is not None and abs(source.n_bytes / 1e6 - form.size_mb) < 2
    if source.hub is not None:
        assert source.hub.repository == form.repository and source.hub.files == form.files
        stated = {file.name: file.sha256 for file in source.hub.weights if file.name in form.sha256}
    else:
        assert [file.address for file in source.files] == [form.source]
        stated = {file.name: file.sha256 for file in source.files}
    assert stated == dict(form.sha256)


def test_every_fact_has_a_reference_and_every_file_uses_https() -> None:
    for source in built_in().entries.values():
        assert source.licence.read_at and (source.n_bytes is not None or source.group == "scannet")
        for file in source.files:
            assert file.read_at and file.address.startswith("https://")


@pytest.mark.parametrize(
    ("address", "printed"),
    [
        ("http://example.org/a", "is not encrypted"),
        ("file:///etc/passwd", "is not an address"),
        ("https://", "is not an address"),
        ("https://[::1", "is not an address"),
        ("https://example.org/a b\n", "is not an address"),
        ("https://user@example.org/a", "a user name or password"),
        ("https://evil-hf.co/a", "is not allowed for it"),
        ("https://hf.co.example.org/a", "is not allowed for it"),
    ],
)
def test_unsafe_address_is_rejected(address: str, printed: str) -> None:
    with pytest.raises(ValueError, match=printed):
        check_address(address, ["huggingface.co", "*.hf.co"])
