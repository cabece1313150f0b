"""Any other program as a method: it is run once per scene, gets the frames in a folder, and writes a prediction.

Dataset folders may have malicious names, such as ``x$(touch y)``. A value is never inserted into code: it is passed as
an argument or in the environment; a shell line gets the variable instead.
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
from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import Detections, Frame, PerceptionNeeds, SceneInfo, Surface

PLACEHOLDER = re.compile(r"\{(\w*)\}")
PLACEHOLDERS = ("frames", "output", "work", "scene", "dataset", "seed")
BESIDE = re.compile(r"[\w./:=,@%+~\[\]-]*")  # characters allowed in one word with a placeholder: no code
INTERPRETER = re.compile(
    r"(ba|da|a|z|k|mk|fi|c|tc)?sh|busybox|su|runuser|script|flock|(python|pypy|perl|ruby|lua|php)[\d.]*|node|nodejs|deno"
    r"|bun|R|Rscript|luajit|julia|octave"
)
WITH_A_VALUE = re.compile(r"-[OWX]|-[a-z]*o")  # interpreter options whose value may be a separate word
CODE_OPTION = re.compile(r"-[A-Za-z]*[ceEpr]|--(eval|command|print|execute)=?")  # followed by a program


def variable_of(name: str) -> str:
    """The environment variable that holds the value of a placeholder.

    >>> variable_of("scene")
    'SU3D_SCENE'
    """
    return f"SU3D_{name.upper()}"


def check_placeholders(command: str | Sequence[str], *, is_shell: bool) -> None:
    """Raises ``ValueError`` for an unknown placeholder, or one whose value would be read as code."""
    if isinstance(command, str) and is_shell:
        for name in _misplaced(command):
            right = f'write {{{name}}} outside of quotes, or "${variable_of(name)}"'
            raise ValueError(f"'{{{name}}}' is where a shell would read its value as commands; {right}")
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
                f"'{{{names[0]}}}' is inside text that may be read as code; make it a separate argument, or use "
                f"the environment variable {variable_of(names[0])} there"
            )


def _misplaced(line: str) -> Iterator[str]:
    """The placeholders of a shell line whose value would be read as commands, or fed to a shell."""
    for found in PLACEHOLDER.finditer(line):
        before = line[: found.start()]
        unescaped = re.sub(r"\\.|(?:^|\s)#[^\n]*", "", before)
        is_quoted = unescaped.count("'") % 2 or unescaped.count('"') % 2
        if found[1] in PLACEHOLDERS and (is_quoted or "<<" in before or before.endswith(("$", "\\"))):
            yield found[1]


def _is_code(words: Sequence[str], k: int) -> bool:
    """Whether an interpreter reads the ``k``-th word (preceded only by its options) as a program."""
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
logger.setLevel(logging.INFO)  # the program's output goes to the log of its scene

Text = Annotated[str, Field(min_length=1)]
Name = Annotated[str, Field(pattern=r"^([^-\s]\S*)?$")]  # an option is not a name
# The program's environment unless more is allowed: enough to start it, no credentials.
ENVIRONMENT = ("PATH", "HOME", "LANG", "LC_ALL", "TZ", "CUDA_VISIBLE_DEVICES", "LD_LIBRARY_PATH")
INSIDE = {"frames": "/su3d/frames", "output": "/su3d/output", "work": "/su3d/work"}  # paths in a container


class CommandConfig(BaseModel):
    """What is run and how; see docs/methods/command-method.md for examples.

    - ``command``: words, or one line that is split like in a shell; {frames}, {output}, {work}, {scene}, {dataset}
      and {seed} are replaced in both, and are in the environment as SU3D_FRAMES and so on. ``shell``: the
      line is run by /bin/sh instead, and uses the variables
    - ``runner``: plain, docker (with ``image``, ``gpus`` as in docker, ``network``) or conda (with
      ``environment``, a name or a folder). ``mounts``: additional folders for the container, HERE:THERE, read-only
    - ``pass_variables``: environment variables passed to the program, if set
    - ``format``: of the prediction, if it cannot be recognized; ``classes_of``: the protocol whose class numbers the
      program writes, if the dataset has several lists
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
            raise ValueError("shell = true requires the command as one line, not a list of words")
        check_placeholders(self.command, is_shell=self.shell)
        needed = {"docker": ("image", self.image), "conda": ("environment", self.environment)}.get(self.runner)
        if needed is not None and not needed[1]:
            raise ValueError(f"runner '{self.runner}' needs {needed[0]}")
        if (self.image or self.mounts or self.gpus or self.network) and self.runner != "docker":
            raise ValueError("image, mounts, gpus and network require runner 'docker'")
        if self.environment and self.runner != "conda":
            raise ValueError("environment requires runner 'conda'")
        if self.format is not None:
            from su3d_bench.predictions.formats import READERS  # slow for a list of methods

            if self.format not in READERS:
                raise ValueError(f"unknown format '{self.format}'; known: {', '.join(READERS)}")
        return self

    @property
    def words(self) -> tuple[str, ...]:
        """The command for the program, with placeholders."""
        if not isinstance(self.command, str):
            return self.command
        return ("/bin/sh", "-c", self.command) if self.shell and self.command else tuple(shlex.split(self.command))


class Command:
    """Runs your program once per scene: frames in a folder, a prediction in any format that evaluate reads."""

    name = "command"
    is_system = False
    Config = CommandConfig
    has_own_perception = True
    about = MethodAbout(
        paper="",
        source="",
        licence="that of the program",
        needs=("your program", "docker or conda if used"),
        status="writing frames and reading predictions are tested in both directions; the program itself is not",
    )

    def __init__(self, config: CommandConfig | None = None) -> None:
        self.config = config or CommandConfig()
        if not self.config.words:
            raise ConfigError("method 'command': no program; use --set 'command.command=[\"run.sh\", \"{frames}\"]'")
        self._scene: SceneInfo | None = None
        self._frames: FrameFolder | None = None
        self._surface: Surface | None = None
        self._scratch: TemporaryFolder | None = None
        # Costs of the program's last run: ``program_s`` and, if measured, ``program_peak_bytes``.
        self.finish_costs: dict[str, float | int] = {}

    @property
    def needs(self) -> PerceptionNeeds:
        """Frames only: the program has its own perception."""
        return PerceptionNeeds(masks="none")

    @property
    def inputs(self) -> Mapping[str, str]:
        """Digest of each file in the command, so that another version of a program is another run."""
        if self.config.runner == "docker":
            return {}  # its words are files in the image
        command = self.config.command
        try:
            words = shlex.split(command) if isinstance(command, str) else command
        except ValueError:  # only a shell can split it: split at spaces
            words = str(command).split()
        files = {word: _program_file(word) for word in words}
        return {f"file {word}": digest_file(path) for word, path in files.items() if path is not None}

    def start(self, scene: SceneInfo) -> None:
        self.close()
        self._scene, self._surface = scene, None
        try:
            self._surface = scene.surface()
        except DataError as error:
            logger.info("no mesh.ply for the program: %s", error)
        self._scratch = TemporaryFolder("su3d-command-")
        self._frames = FrameFolder(self._scratch.path / "frames", scene, self.config.colour, self._surface)
        self._frames.open()

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Adds the frame to the folder; the program runs when the map is requested."""
        assert self._frames is not None, "update before start"
        with timer.stage("export"):
            self._frames.add(frame)

    def finish(self) -> Prediction:
        """The program's map of the frames so far."""
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
        """Remove the program's folders."""
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
        variables = {variable_of(name): value for name, value in self._values(places).items()}
        id_file = folders["frames"].parent / "container"
        id_file.unlink(missing_ok=True)
        if container is not None:
            words = [*self._docker_words(container, id_file, folders, variables), *words]
        elif self.config.runner == "conda":
            kind = "--prefix" if "/" in self.config.environment else "--name"
            words = ["conda", "run", "--no-capture-output", kind, self.config.environment, *words]
        environment = {name: os.environ[name] for name in self.config.pass_variables if name in os.environ} | variables
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
            raise PredictionError(f"terminated after {self.config.timeout_s:g} s (timeout_s){last}")
        if done.exit_code != 0:
            how = f"exit code {done.exit_code}" if done.exit_code > 0 else f"terminated by signal {-done.exit_code}"
            raise PredictionError(f"{how}{last}")

    def _values(self, folders: Mapping[str, str]) -> dict[str, str]:
        assert self._scene is not None
        own = {"scene": self._scene.scene, "dataset": self._scene.dataset, "seed": str(self._scene.seed)}
        return {name: (own | dict(folders))[name] for name in PLACEHOLDERS}

    def _filled(self, folders: Mapping[str, str]) -> list[str]:
        values = self._values(folders)
        if self.config.shell:  # a scene name is never inserted into shell commands
            values = {name: f'"${variable_of(name)}"' for name in values}
        words = [PLACEHOLDER.sub(lambda match: values.get(match[1], match[0]), word) for word in self.config.words]
        if self.config.runner == "docker":
            return words
        # The program runs in another folder: relative file names must be made absolute.
        return [str(Path(w).absolute()) if (k or "/" in w) and is_file(Path(w)) else w for k, w in enumerate(words)]

    def _docker_words(
        self, container: str, id_file: Path, folders: Mapping[str, Path], variables: Mapping[str, str]
    ) -> list[str]:
        mounts = [f"{folders[name]}:{INSIDE[name]}{':ro' if name == 'frames' else ''}" for name in INSIDE]
        mounts += [f"{mount}:ro" for mount in self.config.mounts]
        words = ["docker", "run", "--rm", "--init", "--name", container, "--cidfile", str(id_file)]
        words += ["--user", f"{os.getuid()}:{os.getgid()}", "--workdir", INSIDE["work"]]
        words += [] if self.config.network else ["--network", "none"]
        words += ["--gpus", self.config.gpus] if self.config.gpus else []
        for mount in mounts:
            words += ["--volume", mount]
        # The container has its own PATH and HOME.
        passed = [name for name in self.config.pass_variables if name in os.environ and name not in ENVIRONMENT]
        for name in [*passed, *variables]:
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
    """The file that a word of the command refers to, if any; a bare name is looked up like by the system."""
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
