"""What reads stored perception, settings of models and what language models answered."""

from __future__ import annotations

import gzip
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fuzzing import Make, Read, Target, every_one_of


def _gsa(folder: Path) -> Read:
    from test_perception_gsa import FRAME, PATTERN, SCENE, detections, write

    from su3d_bench.perception.stored_masks import GsaFiles

    write(folder, detections())
    return lambda: GsaFiles(folder, PATTERN, SCENE).frame(FRAME)


def _gsa_inside(folder: Path) -> Read:
    """The same with the gzip left whole."""
    from test_perception_gsa import FRAME, PATTERN, SCENE, detections, write

    from su3d_bench.perception.stored_masks import GsaFiles

    path, plain = write(folder, {}), folder / "plain.pkl"
    plain.write_bytes(pickle.dumps(detections(), 4))

    def read() -> object:
        path.write_bytes(gzip.compress(plain.read_bytes() if plain.is_file() else b"", 1))
        return GsaFiles(folder, PATTERN, SCENE).frame(FRAME)

    return read


def _stored(folder: Path) -> Read:
    from perception_fakes import CountingEncoder, still_life
    from test_perception_stored import written

    from su3d_bench.perception.stored import read_stored

    path, encoder = written(folder, with_features=True), CountingEncoder()
    return lambda: read_stored(path, still_life(40), encoder)


def _label_images(folder: Path) -> Read:
    from perception_fakes import still_life
    from test_perception_stored_images import PATTERN, SCENE, write_image

    from su3d_bench.perception.stored_masks import LabelImages

    write_image(folder)
    return lambda: LabelImages(folder, PATTERN, None, SCENE).regions(still_life(40))


def _names(name: str) -> Make:
    def make(folder: Path) -> Read:
        from su3d_bench.perception.stored_masks import read_names

        table = {"48": "book", "132": "box of things"}
        lines = "".join(f'{key} = "{text}"\n' for key, text in table.items())
        (folder / name).write_text(json.dumps(table) if name.endswith("json") else lines)
        return lambda: read_names(folder / name, "rgbd/desk")

    return make


def _words(folder: Path) -> Read:
    from su3d_bench.perception.models.masks.tagging import read_word_list

    (folder / "words.txt").write_text("# things\nchair\ncoffee table\nplant\n")
    return lambda: read_word_list(folder / "words.txt")


def _model_settings(name: str, of: Callable[[Any], tuple[Any, Callable[[Path], object]]]) -> Make:
    def make(folder: Path) -> Read:
        import model_settings as settings

        content, read = of(settings)
        path = folder / name
        path.write_text(json.dumps(content))
        return lambda: read(path)

    return make


def _tagger_manifest(folder: Path) -> Read:
    from su3d_bench.perception.models.masks.tagging import RAM_MODEL, RAM_TAG_LIST, RamManifest

    digests = {RAM_MODEL: "0" * 64, RAM_TAG_LIST: "1" * 64}
    path = folder / "manifest.json"
    path.write_text(json.dumps({"format": RamManifest.FORMAT, "name": "ram-plus", "files": digests}))
    return lambda: RamManifest.read(path)


def _kept_replies(folder: Path) -> Read:
    from test_language_client import ask

    from su3d_bench.perception.language.chat import Reply
    from su3d_bench.perception.language.reply_store import ReplyStore

    store = ReplyStore(folder / "language")
    request = ask("What is that?")
    store.save(request, Reply("a chair", "stop", "made", 3, 2, ()), "server")
    key = next((folder / "language").glob("*.json")).stem
    return lambda: store.load(key)


def _completion(folder: Path) -> Read:
    """What a server answered that says the key back: none of it may stay."""
    from chat_server import KEY
    from test_language_client import ask

    from su3d_bench.perception.language.client import Server, _Failed
    from su3d_bench.perception.language.config import LanguageConfig

    content = {
        "model": "made",
        "choices": [{"message": {"content": f"a chair {KEY}", "refusal": None}, "finish_reason": f"stop {KEY}"}],
        "usage": {"prompt_tokens": 3, "completion_tokens": 2},
    }
    path = folder / "answer.json"
    path.write_text(json.dumps(content))
    server, request = Server(LanguageConfig()), ask("What is that?")
    server._key = KEY

    def read() -> object:
        content = path.read_bytes() if path.is_file() else b""
        try:
            said: object = server._reply(request, content, ())
        except _Failed as failed:
            said = failed
        if KEY in f"{said!r} {said}":
            raise AssertionError(f"the key is kept: {said}")
        return said

    return read


def _refined_names(folder: Path) -> Read:
    from su3d_bench.core.digests import digest_file
    from su3d_bench.questions.refining import FILE_NAME, SCHEMA, FilterConfig, read_records
    from su3d_bench.store.run_folder import RunFolder

    job = RunFolder(folder).job("rooms/living0", "opensu3d")
    job.prepare()
    job.prediction.write_bytes(b"a map")
    name = {"id": 3, "label": "chair", "refined": "armchair", "source": "vote", "reason": "", "candidates": []}
    content = {"schema_version": SCHEMA, "prediction_sha256": digest_file(job.prediction), "refiner": "vote"}
    content |= {"model": "", "top_m": 5, "filter": FilterConfig().model_dump()}
    (job.path / FILE_NAME).write_text(json.dumps({**content, "names": [{**name, "request": "", "left_out": ""}]}))
    return lambda: read_records(job)


def _kept_files(folder: Path) -> Read:
    from test_store import small_map

    from su3d_bench.core.files.atomic import read_json, read_npz, write_npz
    from su3d_bench.store.predictions import prediction_arrays

    write_npz(folder / "a.npz", prediction_arrays(small_map()))
    (folder / "a.json").write_text(json.dumps({"a": [1, 2.5, None], "b": {"c": "text"}}))
    return lambda: every_one_of(iter((lambda: read_json(folder / "a.json"), lambda: read_npz(folder / "a.npz"))))


TARGETS = (
    Target("gsa detections", _gsa, ("**/*.pkl.gz",), 0.5),
    Target("gsa detections inside", _gsa_inside, ("plain.pkl",), 0.5),
    Target("stored detections", _stored, ("**/*.npz",)),
    Target("label images", _label_images, ("*.png",)),
    Target("names.toml", _names("names.toml"), ("names.toml",)),
    Target("names.json", _names("names.json"), ("names.json",)),
    Target("word list", _words, ("words.txt",)),
    Target(
        "encoder manifest",
        _model_settings("manifest.json", lambda one: (one.ENCODER, one.EncoderManifest.read)),
        ("*",),
    ),
    Target("sam manifest", _model_settings("manifest.json", lambda one: (one.SEGMENTER, one.SamManifest.read)), ("*",)),
    Target(
        "model config", _model_settings("config.json", lambda one: (one.CONFIG, one.encoder_spec)), ("config.json",)
    ),
    Target(
        "preprocessor",
        _model_settings("preprocessor_config.json", lambda one: (one.PREPROCESSOR, one.encoder_spec)),
        ("preprocessor_config.json",),
    ),
    Target("tagger manifest", _tagger_manifest, ("*",)),
    Target("kept replies", _kept_replies, ("language/*.json",)),
    Target("refined names", _refined_names, ("**/*.json",)),
    Target("completion", _completion, ("answer.json",)),
    Target("kept files", _kept_files, ("*",)),
)
