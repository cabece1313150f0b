"""Any other program as a method: run once per scene, it gets all frames in a folder, or one by one while it runs."""

from __future__ import annotations

import logging
import os
import shlex
import shutil
import sys
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from su3d_bench.baselines.command.folders import ColourFormat, FrameFolder, as_prediction, class_names, read_output
from su3d_bench.baselines.command.frame_by_frame import SceneProgram, saved_scene
from su3d_bench.baselines.command.pipes import PipedProgram
from su3d_bench.baselines.command.placeholders import PLACEHOLDER, PLACEHOLDERS, check_placeholders, variable_of
from su3d_bench.baselines.command.process import Finished, run_program
from su3d_bench.core.digests import digest_file
from su3d_bench.core.errors import ConfigError, DataError, PredictionError, Su3dError, printable
from su3d_bench.core.files.atomic import TemporaryFolder, is_file
from su3d_bench.core.interfaces import MethodAbout, StageTimer
from su3d_bench.core.maps import Prediction
from su3d_bench.core.types import Detections, Float64Array, Frame, PerceptionNeeds, SceneInfo, Surface

logger = logging.getLogger(__name__)
logger.setLevel(logging.INFO)  # the program's output goes to the log of its scene

Text = Annotated[str, Field(min_length=1)]
Name = Annotated[str, Field(pattern=r"^([^-\s]\S*)?$")]  # an option is not a name
# The program's environment unless more is allowed: enough to start it, no credentials.
ENVIRONMENT = ("PATH", "HOME", "LANG", "LC_ALL", "TZ", "CUDA_VISIBLE_DEVICES", "LD_LIBRARY_PATH")
PIPES = "pipes"  # a folder with the pipes of a program that gets one frame after another
INSIDE = {name: f"/su3d/{name}" for name in ("frames", "output", "work", PIPES)}  # paths in a container
READ_ONLY = ("frames", PIPES)  # in a container; pipes in such a folder can be written


class CommandConfig(BaseModel):
    """What is run and how; see docs/methods/command-method.md for examples.

    - ``command``: words, or one line that is split like in a shell; {frames}, {output}, {work}, {scene}, {dataset}
      and {seed} are replaced in both, and are in the environment as SU3D_FRAMES and so on. ``shell``: the
      line is run by /bin/sh instead, and uses the variables
    - ``runner``: plain, docker (with ``image``, ``gpus`` as in docker, ``network``) or conda (with
      ``environment``, a name or a folder). ``mounts``: additional folders for the container, HERE:THERE, read-only
    - ``pass_variables``: environment variables passed to the program, if set
    - ``frame_by_frame``: the program runs during the whole scene and answers messages; ``timeout_s`` is for one answer
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
    frame_by_frame: bool = False
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
    """Runs your program once per scene: frames in a folder or one by one, maps in any format that evaluate reads."""

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
        self._program: SceneProgram | None = None  # the running program of ``frame_by_frame``
        self.as_of: int | None = None
        # Costs of the program until its last map: ``program_s`` and, if measured, ``program_peak_bytes``.
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
        if self.config.frame_by_frame:
            self._start_program()

    def update(self, frame: Frame, detections: Detections, timer: StageTimer) -> None:
        """Gives the frame to the running program, or adds it to the folder that the program gets with ``finish``."""
        assert self._frames is not None, "update before start"
        if self._program is not None:
            with timer.stage("program"), self._errors():
                self._program.send(frame)
            return
        with timer.stage("export"):
            self._frames.add(frame)

    def finish(self) -> Prediction:
        """The program's map of the frames so far."""
        assert self._frames is not None and self._scene is not None, "finish before start"
        with self._errors():
            if self._program is None:
                self._frames.close()
                output = self._run()
            else:
                output, self.as_of = self._program.current_map()
                watch = self._program.piped.program.watch
                watch.look()
                self._set_costs(self._program.piped.waited_s, watch.peak_bytes)
            prediction = read_output(output, self._scene.scene, self.config.format)
            for remark in prediction.remarks:
                logger.warning("%s", printable(remark))
            names = class_names(prediction.content, self._scene.dataset, self.config.classes_of)
            return as_prediction(prediction.content, self._surface, names)

    def revise(self, poses: Mapping[int, Float64Array]) -> None:
        """Moves frames, if the program can; ``ConfigError`` if it refuses."""
        with self._errors():
            self._running_program("be revised").revise(poses)

    def save_state(self, folder: Path) -> None:
        """Stores the program's state; ``ConfigError`` if it refuses."""
        with self._errors():
            self._running_program("be saved").save(folder, self._surface)

    def load_state(self, folder: Path) -> None:
        """Starts the program with a saved state."""
        scene, numbers = saved_scene(folder)
        self.start(scene)
        with self._errors():
            self._running_program("be loaded").load(folder, numbers)

    def close(self) -> None:
        """End a running program and remove its folders."""
        program, self._program = self._program, None
        try:
            if program is not None:
                has_failed = sys.exc_info()[0] is not None  # the run, or it was interrupted
                self._log(program.piped.end(in_order=not has_failed))
        finally:
            if self._scratch is not None:
                self._scratch.close()
            self._scratch = self._frames = None

    def __del__(self) -> None:
        if getattr(self, "_scratch", None) is not None:
            self.close()

    def _running_program(self, what: str) -> SceneProgram:
        if self._program is None:
            raise ConfigError(f"method 'command': cannot {what} unless frame_by_frame = true")
        return self._program

    @property
    def _folders(self) -> dict[str, Path]:
        assert self._scratch is not None
        names = [name for name in INSIDE if name != PIPES or self.config.frame_by_frame]
        return {name: self._scratch.path / name for name in names}

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Errors in the block name the scene."""
        assert self._scene is not None
        output = str(self._folders["output"])
        try:
            yield
        except Su3dError as error:
            text = str(error).replace(output, "{output}")
            kind = ConfigError if isinstance(error, ConfigError) else PredictionError
            raise kind(f"{self._scene.dataset}/{self._scene.scene}: command: {text}") from error

    def _start_program(self) -> None:
        assert self._scene is not None
        for folder in self._folders.values():
            folder.mkdir(exist_ok=True)
        with self._errors():
            words, places, options = self._command()
            program = PipedProgram(self._folders[PIPES], self.config.timeout_s, words, **options)
            self._program = SceneProgram(program, self._scene, self._folders, places)
            self._program.start()

    def _run(self) -> Path:
        """The folder with the program's output."""
        folders = self._folders
        for name in ("output", "work"):
            shutil.rmtree(folders[name], ignore_errors=True)
            folders[name].mkdir()
        words, _, options = self._command()
        done = run_program(words, timeout_s=self.config.timeout_s, **options)
        self._set_costs(done.wall_s, done.peak_memory_bytes)
        self._log(done)
        if done.is_timed_out:
            raise PredictionError(f"terminated after {self.config.timeout_s:g} s (timeout_s){done.last_line}")
        if done.exit_code != 0:
            raise PredictionError(f"{done.ending}{done.last_line}")
        return folders["output"]

    def _command(self) -> tuple[list[str], dict[str, str], dict[str, Any]]:
        """The words of the program, its folders as it sees them, and the arguments of ``Program``."""
        folders = self._folders
        container = f"su3d-{uuid.uuid4().hex[:16]}" if self.config.runner == "docker" else None
        places = {name: INSIDE[name] if container else str(path) for name, path in folders.items()}
        words = self._filled(places)
        variables = {variable_of(name): value for name, value in (self._values(places) | places).items()}
        id_file = folders["frames"].parent / "container"
        id_file.unlink(missing_ok=True)
        if container is not None:
            words = [*self._docker_words(container, id_file, folders, variables), *words]
        elif self.config.runner == "conda":
            kind = "--prefix" if "/" in self.config.environment else "--name"
            words = ["conda", "run", "--no-capture-output", kind, self.config.environment, *words]
        environment = {name: os.environ[name] for name in self.config.pass_variables if name in os.environ} | variables
        logger.info("program: %s", printable(shlex.join(words)))
        options = {"folder": folders["work"], "environment": environment, "scratch": folders["frames"].parent}
        if container is not None:
            # `docker run` may end before its container does: ending the client is not enough.
            options |= {"id_file": id_file, "afterwards": ("docker", "kill", container)}
        return words, places, options

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
        mounts = [f"{path}:{INSIDE[name]}{':ro' if name in READ_ONLY else ''}" for name, path in folders.items()]
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

    def _set_costs(self, program_s: float, peak_bytes: int | None) -> None:
        self.finish_costs = {"program_s": round(program_s, 3)}
        if peak_bytes is not None:
            self.finish_costs["program_peak_bytes"] = peak_bytes

    def _log(self, done: Finished) -> None:
        n_bytes = done.peak_memory_bytes
        memory = "" if n_bytes is None else f"{n_bytes / 2**20:.0f} MiB "
        took = f"{done.wall_s:.1f} s, {done.ending}, peak memory {memory}({done.memory_source})"
        logger.info("the program took %s", took)
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
