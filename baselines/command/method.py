"""Any other program as a method: it is run once a scene, gets the frames in a folder, and leaves a prediction.

Folders of datasets have names that others chose, such as ``x$(touch y)``. No value is ever read as a part of a program:
it reaches the program as a word, or through its environment; a shell's line gets the variable in its place.
"""

from __future__ import annotations

import logging
import os
import re
import shlex
import shutil
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from su3d_bench.baselines.command.folders import ColourFormat, FrameFolder, as_prediction, class_names, read_output
from su3d_bench.baselines.command.process import Finished, run_program
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, DataError, PredictionError, Su3dError, printable
from su3d_bench.core.files.atomic import TemporaryFolder, is_file
from su3d_bench.core.interfaces import MethodAbout, SceneTools, StageTimer
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import Detections, Frame, PerceptionNeeds, SceneInfo, Surface

PLACEHOLDER = re.compile(r"\{(\w*)\}")
PLACEHOLDERS = ("frames", "output", "work", "scene", "dataset", "seed")
BESIDE = re.compile(r"[\w./:=,@%+~\[\]-]*")  # what may stand in one word with a placeholder: nothing that is code
INTERPRETER = re.compile(
    r"(ba|da|a|z|k|mk|fi|c|tc)?sh|busybox|su|runuser|script|flock|(python|pypy|perl|ruby|lua|php)[\d.]*|node|nodejs|deno"
    r"|bun|R|Rscript|luajit|julia|octave"
)
WITH_A_VALUE = re.compile(r"-[OWX]|-[a-z]*o")  # options of interpreters whose value may be a word of its own
CODE_OPTION = re.compile(r"-[A-Za-z]*[ceEpr]|--(eval|command|print|execute)=?")  # a program follows it


def variable_of(name: str) -> str:
    """The environment variable that holds the value of a placeholder.

    >>> variable_of("scene")
    'SU3D_SCENE'
    """
    return f"SU3D_{name.upper()}"


def check_placeholders(command: str | Sequence[str], *, is_shell: bool) -> None:
    """Raises ``ValueError`` for an unknown placeholder, or one whose value a program would read as code."""
    if isinstance(command, str) and is_shell:
        for name in _misplaced(command):
            right = f'write {{{name}}} outside of quotes, or "${variable_of(name)}"'
            raise ValueError(f"'{{{name}}}' stands where a shell would read its value as commands; {right}")
        return
    words = shlex.split(command) if isinstance(command, str) else command
    for k, word in enumerate(words):
        names = [name for name in PLACEHOLDER.findall(word) if name]
        if not names:
            continue
        if unknown := [name for name in names if name not in PLACEHOLDERS]:
            raise ValueError(f"'{{{unknown[0]}}}' is an unknown placeholder; known: {{{'}, {'.join(PLACEHOLDERS)}}}")
        if not BESIDE.fullmatch(PLACEHOLDER.sub("", word)) or _is_code(words, k):
            raise ValueError(
                f"'{{{names[0]}}}' is inside what a program may read as code; make it an argument of its own, or use "
                f"the environment variable {variable_of(names[0])} there"
            )


def _misplaced(line: str) -> Iterator[str]:
    """The placeholders of a shell's line that stand where its quotes would be undone, or where a shell is fed."""
    for found in PLACEHOLDER.finditer(line):
        before = line[: found.start()]
        unescaped = re.sub(r"\\.|(?:^|\s)#[^\n]*", "", before)
        is_quoted = unescaped.count("'") % 2 or unescaped.count('"') % 2
        if found[1] in PLACEHOLDERS and (is_quoted or "<<" in before or before.endswith(("$", "\\"))):
            yield found[1]


def _is_code(words: Sequence[str], k: int) -> bool:
    """Whether an interpreter reads the ``k``-th word, behind nothing but its options, as a program."""
    for start in (n for n in range(k) if INTERPRETER.fullmatch(PurePath(words[n]).name)):
        between = words[start + 1 : k]
        are_options = all(
            word.startswith(("-", "+")) or (n > 0 and WITH_A_VALUE.fullmatch(between[n - 1]))
            for n, word in enumerate(between)
        )
        options = [*between, PLACEHOLDER.split(words[k])[0]]
        if are_options and any(CODE_OPTION.fullmatch(option) for option in options):
            return True
    return False


logger = logging.getLogger(__name__)
logger.setLevel(logging.INFO)  # what a program prints goes to the log of its scene

Text = Annotated[str, Field(min_length=1)]
Name = Annotated[str, Field(pattern=r"^([^-\s]\S*)?$")]  # no option in the place of a name
# What a program finds in its environment unless more is allowed: enough to start it, no credentials.
ENVIRONMENT = ("PATH", "HOME", "LANG", "LC_ALL", "TZ", "CUDA_VISIBLE_DEVICES", "LD_LIBRARY_PATH")
INSIDE = {"frames": "/su3d/frames", "output": "/su3d/output", "work": "/su3d/work"}  # of a container


class CommandConfig(BaseModel):
    """What is run and where; docs/methods/command-method.md says it with examples.

    - ``command``: words, or one line that is split as a shell splits it; {frames}, {output}, {work}, {scene}, {dataset}
      and {seed} stand for themselves in either, and are in the environment as SU3D_FRAMES and so on. ``shell``: the
      line goes to /bin/sh instead, and gets them from there
    - ``runner``: plain, docker (with ``image``, ``gpus`` as docker has them, ``network``) or conda (with
      ``environment``, a name or a folder). ``mounts``: more folders for the container, HERE:THERE, read-only
    - ``pass_variables``: the environment variables that the program gets, of those that are set
    - ``format``: of the prediction, where it cannot be recognised; ``classes_of``: the protocol whose class numbers the
      program writes, where the dataset has several lists
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    command: tuple[Text, ...] | str = ()
    shell: bool = False
    runner: Literal["plain", "docker", "conda"] = "plain"
    image: Name = ""
    gpus: str = ""
    network: bool = False
    environment: Name = ""
    mounts: tuple[Annotated[str, Field(pattern=r"^/[^:]*:/[^:]*$")], ...] = ()
    pass_variables: tuple[Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")], ...] = ENVIRONMENT
    timeout_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3600.0
    format: str | None = None
    classes_of: str | None = None
    colour: ColourFormat = "png"
    stride: Annotated[int, Field(ge=1)] = 1

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.shell and not isinstance(self.command, str):
            raise ValueError("shell = true takes the command as one line; a list of words needs no shell")
        check_placeholders(self.command, is_shell=self.shell)
        needed = {"docker": ("image", self.image), "conda": ("environment", self.environment)}.get(self.runner)
        if needed is not None and not needed[1]:
            raise ValueError(f"runner '{self.runner}' needs {needed[0]}")
        if (self.image or self.mounts or self.gpus or self.network) and self.runner != "docker":
            raise ValueError("image, mounts, gpus and network belong to runner 'docker'")
        if self.environment and self.runner != "conda":
            raise ValueError("environment belongs to runner 'conda'")
        if self.format is not None:
            from su3d_bench.predictions.formats import READERS  # not for a list of methods

            if self.format not in READERS:
                raise ValueError(f"unknown format '{self.format}'; known: {', '.join(READERS)}")
        return self

    @property
    def words(self) -> tuple[str, ...]:
        """The command as the program gets it, placeholders unfilled."""
        if not isinstance(self.command, str):
            return self.command
        return ("/bin/sh", "-c", self.command) if self.shell and self.command else tuple(shlex.split(self.command))


class Command:
    """Runs a program of yours once a scene: frames in a folder, a prediction in any format that evaluate reads."""

    name = "command"
    is_system = False
    Config = CommandConfig
    has_own_perception = True
    about = MethodAbout(
        paper="",
        source="",
        licence="that of the program",
        needs=("a program of yours", "docker or conda where it is run there"),
        status="hands over frames and reads predictions as tests of both ways show; vouches for no program",
    )

    def __init__(self, config: CommandConfig | None = None) -> None:
        self.config = config or CommandConfig()
        if not self.config.words:
            raise ConfigError(
                "method 'command': no program is named; --set 'command.command=[\"run.sh\", \"{frames}\"]'"
            )
        self._tools: SceneTools | None = None
        self._scene: SceneInfo | None = None
        self._frames: FrameFolder | None = None
        self._surface: Surface | None = None
        self._scratch: TemporaryFolder | None = None
        # What the last run of the program took: ``program_s`` and, where it was measured, ``program_peak_bytes``.
        self.finish_costs: dict[str, float | int] = {}

    @property
    def needs(self) -> PerceptionNeeds:
        """Frames alone: the program has its own perception."""
        return PerceptionNeeds(masks="none")

    @property
    def inputs(self) -> Mapping[str, str]:
        """Digest of each file that the command names, so that another version of a program is another run."""
        if self.config.runner == "docker":
            return {}  # its words are files of the image
        command = self.config.command
        try:
            words = shlex.split(command) if isinstance(command, str) else command
        except ValueError:  # what a shell alone can split is split at spaces
            words = str(command).split()
        files = {word: _program_file(word) for word in words}
        return {f"file {word}": digest_file(path) for word, path in files.items() if path is not None}

    def receive_tools(self, tools: SceneTools) -> None:
        self._tools = tools

    def start(self, scene: SceneInfo) -> None:
        self.close()
        self._scene, self._surface = scene, None
        if self._tools is not None:
            try:
                self._surface = self._tools.surface()
            except DataError as error:
                logger.info("no mesh.ply for the program: %s", error)
        self._scratch = TemporaryFolder("su3d-command-")
        self._frames = FrameFolder(self._scratch.path / "frames", scene, self.config.colour, self._surface)
        self._frames.open()

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Adds the frame to the folder; the program runs when the map is asked for."""
        assert self._frames is not None, "update before start"
        with timer.stage("export"):
            self._frames.add(frame)

    def finish(self) -> Prediction:
        """What the program makes of the frames so far."""
        assert self._frames is not None and self._scratch is not None and self._scene is not None, "finish before start"
        self._frames.close()
        where = f"{self._scene.dataset}/{self._scene.scene}: command"
        folders = {name: self._scratch.path / name for name in INSIDE}
        for name in ("output", "work"):
            shutil.rmtree(folders[name], ignore_errors=True)
            folders[name].mkdir()
        try:
            self._run(folders)
            prediction = read_output(folders["output"], self._scene.scene, self.config.format)
            for remark in prediction.remarks:
                logger.warning("%s", printable(remark))
            names = class_names(prediction.content, self._scene.dataset, self.config.classes_of)
            return as_prediction(prediction.content, self._surface, names)
        except Su3dError as error:
            text = str(error).replace(str(folders["output"]), "{output}")
            raise PredictionError(f"{where}: {text}") from error

    def close(self) -> None:
        """Remove the folders that the program worked in."""
        if self._scratch is not None:
            self._scratch.close()
        self._scratch = self._frames = None

    def __del__(self) -> None:
        if getattr(self, "_scratch", None) is not None:
            self.close()

    def _run(self, folders: Mapping[str, Path]) -> None:
        container = f"su3d-{uuid.uuid4().hex[:16]}" if self.config.runner == "docker" else None
        places = {name: INSIDE[name] if container else str(path) for name, path in folders.items()}
        words = self._filled(places)
        told = {variable_of(name): value for name, value in self._values(places).items()}
        id_file = folders["frames"].parent / "container"
        id_file.unlink(missing_ok=True)
        if container is not None:
            words = [*self._docker_words(container, id_file, folders, told), *words]
        elif self.config.runner == "conda":
            kind = "--prefix" if "/" in self.config.environment else "--name"
            words = ["conda", "run", "--no-capture-output", kind, self.config.environment, *words]
        environment = {name: os.environ[name] for name in self.config.pass_variables if name in os.environ} | told
        logger.info("program: %s", printable(shlex.join(words)))

        done = run_program(
            words,
            folder=folders["work"],
            environment=environment,
            timeout_s=self.config.timeout_s,
            id_file=None if container is None else id_file,
            # `docker run` may end before its container does: ending the client is not enough.
            afterwards=() if container is None else ("docker", "kill", container),
            scratch=folders["frames"].parent,
        )
        self._record(done)
        last = _last_line(done.stderr)
        if done.is_timed_out:
            raise PredictionError(f"was ended after {self.config.timeout_s:g} s (timeout_s){last}")
        if done.exit_code != 0:
            how = f"exit code {done.exit_code}" if done.exit_code > 0 else f"was ended by signal {-done.exit_code}"
            raise PredictionError(f"{how}{last}")

    def _values(self, folders: Mapping[str, str]) -> dict[str, str]:
        assert self._scene is not None
        own = {"scene": self._scene.scene, "dataset": self._scene.dataset, "seed": str(self._scene.seed)}
        return {name: (own | dict(folders))[name] for name in PLACEHOLDERS}

    def _filled(self, folders: Mapping[str, str]) -> list[str]:
        values = self._values(folders)
        if self.config.shell:  # what a scene is called never stands where a shell reads commands
            values = {name: f'"${variable_of(name)}"' for name in values}
        words = [PLACEHOLDER.sub(lambda match: values.get(match[1], match[0]), word) for word in self.config.words]
        if self.config.runner == "docker":
            return words
        # The program runs in a folder of its own: files that were named from here must be found from there.
        return [str(Path(w).absolute()) if (k or "/" in w) and is_file(Path(w)) else w for k, w in enumerate(words)]

    def _docker_words(
        self, container: str, id_file: Path, folders: Mapping[str, Path], told: Mapping[str, str]
    ) -> list[str]:
        mounts = [f"{folders[name]}:{INSIDE[name]}{':ro' if name == 'frames' else ''}" for name in INSIDE]
        mounts += [f"{mount}:ro" for mount in self.config.mounts]
        words = ["docker", "run", "--rm", "--init", "--name", container, "--cidfile", str(id_file)]
        words += ["--user", f"{os.getuid()}:{os.getgid()}", "--workdir", INSIDE["work"]]
        words += [] if self.config.network else ["--network", "none"]
        words += ["--gpus", self.config.gpus] if self.config.gpus else []
        for mount in mounts:
            words += ["--volume", mount]
        # The container has a PATH and a HOME of its own.
        passed = [name for name in self.config.pass_variables if name in os.environ and name not in ENVIRONMENT]
        for name in [*passed, *told]:
            words += ["--env", name]
        return [*words, self.config.image]

    def _record(self, done: Finished) -> None:
        self.finish_costs = {"program_s": round(done.wall_s, 3)}
        memory = f"peak memory {done.memory_source}"
        if done.peak_memory_bytes is not None:
            self.finish_costs["program_peak_bytes"] = done.peak_memory_bytes
            memory = f"peak memory {done.peak_memory_bytes / 2**20:.0f} MiB ({done.memory_source})"
        logger.info("the program took %.1f s, %s", done.wall_s, memory)
        for name, text in (("stdout", done.stdout), ("stderr", done.stderr)):
            for line in text.splitlines():
                logger.info("%s: %s", name, printable(line, 2000))


def _program_file(word: str) -> Path | None:
    """The file that a word of the command names, if it names one; a bare name is looked for as the system does."""
    if PLACEHOLDER.search(word):
        return None
    path = Path(word).expanduser()
    if not is_file(path) and "/" not in word:
        program = shutil.which(word)
        path = Path(program) if program else path
    return path if is_file(path) else None


def _last_line(stderr: str) -> str:
    lines = [line for line in map(printable, stderr.splitlines()) if line]
    return f"; its last line: {lines[-1][:200]}" if lines else "; it wrote nothing to stderr"
