"""Every command, executed once on one small real run: a smoke test."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzz_words import verbs
from painted_runs import PAINTED

from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_file

SMALL = "--set rooms.width=320 rooms.height=240 --no-pictures --jobs 1"
RUN = (
    f"--scenes rooms/bathroom0 --methods opensu3d oracle --protocols rooms-semantic rooms-instance --stride 200 {SMALL}"
)

# Arguments of each command, its exit code, and a file that it writes or text that it prints.
CASES: dict[str, tuple[str, int, str]] = {
    "run": (f"{RUN} --out out", 0, "| opensu3d"),
    "ablate": (f"--vary m=1,2 --scenes rooms/bathroom0 --limit 2 {SMALL} --out sweep", 0, "sweep/metrics.json"),
    "robustness list": ("", 0, "depth/holes"),
    "robustness show": (
        "rooms/bathroom0 --set rooms.width=160 rooms.height=120 rooms.n_frames=8 --corruptions names --out show.png",
        0,
        "show.png",
    ),
    "robustness run": (
        f"--scenes rooms/bathroom0 --limit 2 {SMALL} --only depth/holes/4 --out robust",
        0,
        "robust/metrics.json",
    ),
    "robustness report": ("robust --figure robust.png", 0, "robust.png"),
    "robustness tolerance": (
        f"--scenes rooms/bathroom0 --limit 2 {SMALL} --corruptions depth/scale --out tolerance",
        0,
        "Tolerated errors of depth",
    ),
    "evaluate": (
        "out/scenes/rooms.bathroom0/opensu3d --dataset rooms --protocols rooms-instance --out evaluated",
        0,
        "evaluated/metrics.json",
    ),
    "check": ("--build-from out --out reference.json", 0, "reference.json"),
    "compare": ("out:opensu3d out:oracle", 0, "rooms-instance"),
    "report power": ("out", 2, "1 scene is scored"),  # variance needs at least two scenes
    "report attribution": ("out --method opensu3d --out errors.png", 0, "errors.png"),
    "report tables": ("out --format latex --out tables.tex", 0, "tables.tex"),
    "report timing": ("out --out timing", 0, "timing/timing.md"),
    "report identity": ("out", 2, "has no intermediate maps"),
    "report changes": ("out", 2, "has no intermediate maps"),
    "report html": ("out --no-maps --out page.html", 0, "page.html"),
    "report instances": ("out --out samples.csv", 0, "predicted instances"),
    "report leaderboard": ("out --out board.md", 0, "board.md"),
    "report bundle": ("out --out registry/bundles/mine.zip", 0, "registry/bundles/mine.zip"),
    "report verify": ("tables.tex", 0, ""),
    "dev registry add": (
        "registry/bundles/mine.zip --registry registry",
        0,
        "4 scores recomputed, identical to the last bit",
    ),
    "dev registry build": ("registry --out site", 0, "site/index.html"),
    "reproduce": ("opensu3d --tables II --dry-run", 1, "su3d-bench datasets fetch replica"),
    "runs list": (".", 0, "opensu3d"),
    "runs show": ("out", 0, "resume: su3d-bench run --config out/run.toml --out out"),
    "runs remove": ("sweep --yes", 0, "removed sweep: complete"),
    "sheets make": ("out --kinds retrieval --per-kind 1 --jobs 1 --out sheets", 0, "sheets"),
    "sheets score": ("--key sheets-key --out scores", 0, "scores/scores.json"),
    "sheets pictures": ("out --texts toilet --out heat.svg", 0, "heat.svg"),
    "query text": ("rooms/bathroom0 'plant on shelf' --run out", 0, "opensu3d"),
    "query make": (f"--scenes {PAINTED}/a --per-kind 1 --out queries.toml", 0, "queries.toml"),
    "query score": ("none.json --answers none.json", 2, "none.json"),
    "query show": ("paper", 0, "904 questions on 13 scenes"),
    "query ask": ("rooms/bathroom0 'What is the largest object?' --run out", 0, "#"),
    "runs refine": ("out", 0, "opensu3d"),
    "datasets list": ("", 0, "replica"),
    "datasets check": ("rooms/bathroom0 --set rooms.width=160 rooms.height=120 --quick", 0, "bathroom0"),
    "datasets show": ("rooms/bathroom0 --set rooms.width=160 rooms.height=120 --out room.png", 0, "room.png"),
    "datasets make": ("rooms --layout replica --scenes bathroom0 --set n_frames=2 --jobs 1 --out made", 0, ""),
    "methods list": ("", 0, "opensu3d"),
    "methods check": ("oracle", 0, "55 instances, without features: OK"),
    "methods show": ("opensu3d", 0, "opensu3d"),
    "models list": ("", 0, "clip-vit-h-14"),
    "models check": ("clip-vit-h-14", 1, "clip-vit-h-14"),
    "models fetch": ("sam-vit-h --dry-run", 0, "sam_vit_h_4b8939.pth"),
    "datasets fetch replica": ("frames --dry-run", 0, "Replica.zip"),
    "datasets fetch scannet": ("", 2, "ScanNet_TOS.pdf"),
    "protocols list": ("", 0, "rooms-semantic"),
    "protocols show": ("rooms-semantic", 0, "rooms-semantic"),
    "protocols diff": ("rooms-semantic replica-mesh-ex6", 0, "vocabulary"),
    "protocols texts": ("--protocol rooms-semantic --encoder embedded --out texts.npz", 0, "texts.npz"),
    "methods new": ("my_method.py", 0, "my_method.py"),
    "datasets new": ("my_dataset.py", 0, "my_dataset.py"),
    "protocols new": ("mine.toml", 0, "mine.toml"),
    "dev registry new": ("my-registry", 0, "my-registry/README.md"),
    "dev completion": ("bash", 0, "complete -o"),
    "dev doctor": ("", 0, "the main job can run"),
    "runs export": ("out --to openlex3d --method opensu3d --out exported", 0, "exported"),
}

# These write nothing, so they can be run twice.
READING = (
    *("compare", "report leaderboard", "runs list", "runs show", "query show", "datasets list", "models list"),
    *("methods list", "methods show", "protocols list", "protocols show", "protocols diff"),
)
FINISHED: dict[str, str] = {}  # digests of the run's files by name, after the command run


@pytest.fixture(scope="module", autouse=True)
def _place(tmp_path_factory: pytest.TempPathFactory, rooms_data: Path) -> Iterator[None]:
    """A folder in which each command uses the results of those before it."""
    folder = tmp_path_factory.mktemp("verbs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("SU3D_DATA", str(rooms_data))
        for name in ("SU3D_CACHE", "SU3D_MODELS"):
            patch.setenv(name, str(folder / name.lower()))
        yield


def test_every_command_of_the_parser_has_a_case() -> None:
    assert sorted(CASES) == sorted(" ".join(words) for words, _ in verbs())


@pytest.mark.parametrize("verb", CASES)
def test_command_succeeds(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, code, left = CASES[verb]
    typed = shlex.split(f"{verb} {words}")
    assert main(typed) == code, capsys.readouterr().err
    answer = capsys.readouterr()
    assert r"\n" not in answer.out + answer.err, "an escaped line break"
    assert left in answer.out + answer.err or Path(left).exists(), answer.out + answer.err
    if verb in READING:
        assert main([*typed, "--json"]) == code
        assert json.loads(capsys.readouterr().out) is not None
    if verb == "run":
        files = [path for path in Path("out").rglob("*") if path.is_file()]
        FINISHED.update({path.as_posix(): digest_file(path) for path in files})
    for name, digest in FINISHED.items():
        assert digest_file(Path(name)) == digest, (
            "a command may add requested files to a finished run, but must not change existing ones"
        )
