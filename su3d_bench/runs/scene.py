"""One scene under all methods of a run: predict, score, draw; the unit of work that executors run.

The ground truth stays here: methods only get frames and detections, except a method that requests the ground truth by
having ``receive_ground_truth`` (the oracle, from which ceilings are computed).
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

from su3d_bench.core import interfaces
from su3d_bench.core.errors import GroundTruthMissing, StoreError, counted, error_line, printable, user_code_line
from su3d_bench.core.files.atomic import write_bytes, write_text
from su3d_bench.core.maps import Prediction
from su3d_bench.core.registry import CEILING_METHOD
from su3d_bench.core.safe_output import one_line
from su3d_bench.core.system.signals import is_interrupt
from su3d_bench.core.system.timing import MethodClock, Timer, device_memory_bytes, peak_memory_bytes, start_memory_watch
from su3d_bench.core.types import (
    BoolArray,
    Frame,
    GroundTruth,
    SceneInfo,
)
from su3d_bench.corruptions.apply import CorruptedPerception
from su3d_bench.metrics.compatibility import kind_incompatibility
from su3d_bench.metrics.metric import SceneScore
from su3d_bench.metrics.protocols.loading import load_protocol
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.metrics.scoring import Truth, pack_scores, score_located, score_scene
from su3d_bench.metrics.seen import reason_against, restricted
from su3d_bench.perception.language.chat import LanguageConfig, ReplyStore
from su3d_bench.perception.language.client import ChatClient
from su3d_bench.perception.profiles import Perception, PerceptionConfig, build_perception, resolve_profile
from su3d_bench.questions.ground_truths import question_truth
from su3d_bench.questions.refining import refine_by_model, refined_names
from su3d_bench.questions.solver import MapSolver, by_language_model
from su3d_bench.reports.pictures.maps import draw_scene
from su3d_bench.reports.tables.run import not_scored_lines
from su3d_bench.runs import frame_loop
from su3d_bench.runs import job as jobs
from su3d_bench.runs.clock import Schedule
from su3d_bench.runs.executors import Report, exceeds_memory
from su3d_bench.runs.frame_loop import SceneLog
from su3d_bench.runs.poses import REMARK, PosesContradicted, judged
from su3d_bench.runs.real_time import is_measured, schedule_of
from su3d_bench.runs.scene_data import SceneData
from su3d_bench.store.predictions import read_prediction
from su3d_bench.store.records import UnscoredRecord
from su3d_bench.store.run_folder import JobFolder, RunFolder

logger = logging.getLogger(__name__)


def run_scene(job: jobs.SceneJob, report: Report) -> tuple[jobs.MethodOutcome, ...]:
    """Outcomes of all methods on one scene, the one of the ceiling last; a failing method does not affect others."""
    # Frames are read in threads, while a method may be in another working directory.
    job = replace(job, data_root=job.data_root.absolute(), cache_root=job.cache_root.absolute())
    if job.doubts is None:
        try:
            (job,) = judged([job])
        except PosesContradicted as error:
            return failed_outcomes(job, str(error).removeprefix(f"{job.scene}: "))
    scene = _Scene(job, report)
    return tuple(_guarded(scene, part) for part in job.parts)


@cache
def warm_up(part: jobs.Part) -> None:
    """Warm up a method that requests it, once per process for each method and its settings."""
    scratch: interfaces.Method = jobs.build_method(part)
    if getattr(scratch, "warms_up", False):
        frame_loop.warm_up(scratch)


def failed_outcomes(job: jobs.SceneJob, reason: str) -> tuple[jobs.MethodOutcome, ...]:
    """The outcome of a scene whose worker died; methods that finished before are kept and resumed next time."""
    line = f"{job.scene}: {reason}"
    for part in job.methods:
        folder = RunFolder(job.folder).job(job.scene, part.name)
        folder.prepare()
        if "score" not in folder.completion_records():
            write_text(folder.log, f"failed: {one_line(line)}\n")
    return tuple(jobs.MethodOutcome(job.scene, part.name, error=line) for part in job.methods)


def scores_again(job: jobs.SceneJob, part: jobs.Part, encoder: interfaces.Encoder) -> dict[str, SceneScore]:
    """The scores of the map of ``part`` in ``job.folder``, by protocol; nothing is written."""
    folder = RunFolder(job.folder).job(job.scene, part.name)
    scores, _ = _Scene(job, lambda event: None).scores(part, encoder, read_prediction(folder.prediction), folder)
    return scores


def _guarded(scene: _Scene, part: jobs.Part) -> jobs.MethodOutcome:
    """The one place where a scene's failure, of any kind, is recorded instead of ending the run."""
    job = scene.job
    folder = RunFolder(job.folder).job(job.scene, part.name)
    folder.prepare()
    log = SceneLog()
    package = logging.getLogger("su3d_bench")
    package.addHandler(log)
    try:
        outcome = scene.run(part, folder, log)
    except BaseException as error:
        if is_interrupt(error) or (isinstance(error, StoreError) and not user_code_line(error)):
            raise
        line = exceeds_memory(error, job.config.memory) or error_line(error)
        name = printable(job.scene)
        line = line if line.startswith(name) else f"{name}: {line}"
        log.lines.append("".join(traceback.format_exception(error)) + f"failed: {line}")
        outcome = jobs.MethodOutcome(job.scene, part.name, error=line)
    finally:
        package.removeHandler(log)
    if outcome.error is not None:
        write_text(folder.log, log.text())
    return outcome


def perception_of(job: jobs.SceneJob, info: SceneInfo, marked: Callable[[], Any] = lambda: None) -> Perception:
    """The perception of the frames of a scene; ``marked`` returns the source of ground-truth masks."""
    config: PerceptionConfig = PerceptionConfig.model_validate_json(job.perception)
    profile = resolve_profile(job.config.profile, info.image_domain, config)
    return build_perception(
        profile,
        config,
        scene=info,
        cache_root=job.cache_root,
        mesh=marked() if profile == "oracle" else None,
        job_index=job.index,
        replies=job.folder / "language",
        is_offline=job.config.offline,
    )


class _Scene(SceneData):
    """One scene whose methods are run and scored."""

    @cached_property
    def language(self) -> tuple[ChatClient, LanguageConfig]:
        """The language model of questions and labels n', and its settings."""
        config = PerceptionConfig.model_validate_json(self.job.perception).language
        return ChatClient(config, ReplyStore(self.job.folder / "language"), offline=self.job.config.offline), config

    @cached_property
    def solver(self) -> MapSolver | None:
        """The solver that answers questions about maps; None: the built-in solver."""
        return None if self.job.config.question_solver == "built-in" else by_language_model(*self.language)

    def run(self, part: jobs.Part, folder: JobFolder, log: SceneLog) -> jobs.MethodOutcome:
        """Predict and score one method, each step only if its completion record is missing or does not match."""
        self.report_activity(part, self.opening)
        method = jobs.build_method(part)
        info = self.dataset.info(self.job.scene_name, jobs.stride_of(self.job, part))
        info = replace(info, seed=self.job.config.seed)
        perception = perception_of(self.job, info, lambda: self.marked)
        if corruption := self.corruption(part):
            perception = CorruptedPerception(perception, corruption)
        config = jobs.config_key(self.job, part, method)
        inputs = jobs.JobInputs(self.job, part.name, config, method, info, perception, self.data_digest)
        key = inputs.predict_key()
        if self.job.replaces and folder.changed_field("predict", key) is not None:
            folder.remove()
            folder.prepare()
        jobs.check_same_run(folder, key)
        was_resumed = folder.is_done("predict", key)
        if was_resumed:
            log.recall(folder.remarks("predict"))
        else:
            self._predict(part, inputs, folder, key, log)
        if self.job.config.refiner == "model" and any(load_protocol(name).uses_names for name in self.job.protocols):
            refine_by_model(folder, *self.language)
        score_key = inputs.score_key(key, folder)
        if not inputs.is_scored(folder, folder.completion_records().get("score"), score_key):
            self._score(part, inputs, folder, score_key, log)
            was_resumed = False
        return inputs.outcome(folder.remarks("score"), was_resumed=was_resumed)

    def _predict(
        self, part: jobs.Part, inputs: jobs.JobInputs, folder: JobFolder, key: Mapping[str, str], log: SceneLog
    ) -> None:
        """Feed a newly created method, so that its construction is timed too, and record its map as complete.

        In real time, a first method is fed only to measure the schedule, which is then replayed: what a map contains
        at a time is known only when the next update has been measured.
        """
        frames: Sequence[Frame] = ()
        points, doubts, schedule = dict[float, int](), tuple[str, ...](), None
        if inputs.method.needs.frames:
            frames, doubts = self.frames(part), self.job.doubts or ()
            points = self.job.config.anytime_points(len(frames))
            if self.job.config.realtime:
                schedule = self._schedule(part, inputs, frames)
                points = {share: schedule.n_fed_by(share) for share in points}
                frames = frame_loop.ChosenFrames(frames, schedule.fed)
        for line in doubts:
            logger.warning("%s", line)
        with self._feeding(part, inputs, inputs.perception, frames) as (feeding, clock):
            n = len(frames)
            with frame_loop.ReadAhead(frames, n, n_ahead=0 if self.is_rendered else frame_loop.N_AHEAD) as ahead:
                for point, n_fed in points.items():
                    feeding.feed_until(n_fed, ahead, n)
                    feeding.write_map(folder.anytime(point))
                feeding.feed_until(n, ahead, n)
            self.report_activity(part, "finishing the map")
            feeding.write_map(folder.prediction)
        write_text(folder.updates, feeding.updates_text())
        files = [folder.prediction, folder.updates, *map(folder.anytime, points)]
        costs: dict[str, Any] = {
            "maps": feeding.maps,
            "calibration_ms": feeding.calibration_ms,
            "peak_rss_bytes": peak_memory_bytes(),
            "device_bytes": device_memory_bytes(),
            "start_ms": round(clock.take("start").method_ms, 3),
            "close_ms": round(clock.take("close").method_ms, 3),
        }
        remarks = {"costs": costs, REMARK: doubts} | log.remarks()
        if schedule is not None:
            write_text(folder.schedule, schedule.text())
            files.append(folder.schedule)
            costs["realtime"] = schedule.numbers()
            remarks["clock"] = schedule.stream.note(part.name)
        folder.mark_complete("predict", key, files, remarks)

    def _schedule(self, part: jobs.Part, inputs: jobs.JobInputs, frames: Sequence[Frame]) -> Schedule:
        """The schedule of a real-time run of ``part``; measured without the cache, whose times are not perception's."""
        config, stride = self.job.config, inputs.info.stride
        make = partial(schedule_of, config, self.job.scene, part.name, len(frames), stride)
        if not is_measured(config):
            return make(cost_ms=None)
        settings: PerceptionConfig = PerceptionConfig.model_validate_json(self.job.perception)
        job = replace(self.job, perception=settings.model_copy(update={"cache": False}).model_dump_json())
        perception = perception_of(job, inputs.info, lambda: self.marked)
        if corruption := self.corruption(part):
            perception = CorruptedPerception(perception, corruption)
        if inputs.method.needs.masks != "none":
            first = frames[0]
            if (first.depth_m > 0).any():
                perception.detect(first, inputs.method.needs, Timer())  # models are loaded at the first call
        with self._feeding(part, inputs, perception, frames) as (feeding, _):
            return make(cost_ms=partial(feeding.measured_ms, frames))

    @contextmanager
    def _feeding(
        self, part: jobs.Part, inputs: jobs.JobInputs, perception: Perception, frames: Sequence[Frame]
    ) -> Iterator[tuple[frame_loop.MethodFeed, MethodClock]]:
        """A new method of ``part``, started, and closed at the end of the block."""
        clock = MethodClock()
        with clock.running("start"):
            method: interfaces.Method = jobs.build_method(part)
        if isinstance(method, interfaces.UsesSceneTools):
            tools = interfaces.SceneTools(
                frames=frames,
                regions=frame_loop.TimedRegions(perception.regions(), clock),
                true_proposals=self.true_proposals if method.needs.true_proposals else None,
                shared=self.shared if part.corruption else {},  # the time of a clean method counts
            )
            with clock.running("start"):
                method.receive_tools(tools)
        if isinstance(method, interfaces.UsesGroundTruth):
            if not self.dataset.variants:
                raise GroundTruthMissing(f"{self.job.scene}: {method.name} needs ground truth, the dataset has none")
            truth = self.first_truth
            with clock.running("start"):
                method.receive_ground_truth(truth)
        self.report_activity(part, "compiling the method")
        warm_up(part)
        self.report_activity(part, self.opening)
        start_memory_watch()
        feeding = frame_loop.MethodFeed(
            self.job.scene, method, perception, lambda event: self.report(replace(event, label=part.name)),
            clock, skips_empty=bool(part.corruption),
        )  # fmt: skip
        try:
            has_surface = isinstance(self.dataset, interfaces.HasSurface)
            read_surface = partial(self.dataset.surface, self.job.scene_name) if has_surface else None
            with clock.running("start"):
                method.start(replace(inputs.info, read_surface=read_surface))
            yield feeding, clock
        finally:
            if isinstance(method, interfaces.Closable):
                with clock.running("close"):
                    method.close()

    def _score(
        self, part: jobs.Part, inputs: jobs.JobInputs, folder: JobFolder, key: Mapping[str, str], log: SceneLog
    ) -> None:
        """Score under every protocol with ground truth here, draw the map, and record both as complete."""
        prediction = read_prediction(folder.prediction)
        scores, unscored = self.scores(part, inputs.perception.encoder, prediction, folder)
        by_file = {folder.counts: scores}
        n_updates = int(folder.remarks("predict")["costs"]["maps"][-1]["n_updates"])
        for point in self.job.config.anytime_points(n_updates):
            early, _ = self.scores(part, inputs.perception.encoder, read_prediction(folder.anytime(point)), None)
            by_file[folder.curve_counts("anytime", point)] = early
        n_seen = self._score_seen(part, inputs, folder, by_file) if part in self.job.methods else 0
        for file, of_file in by_file.items():
            write_bytes(file, pack_scores(of_file))
        files = [*by_file]
        if self.job.config.pictures:
            self.report_activity(part, "drawing the map")
            truth_to_draw = next((known for known in self.truths.values() if isinstance(known, GroundTruth)), None)
            files += draw_scene(prediction, truth_to_draw, folder.pictures, f"{self.job.scene}, {part.name}")
        reasons = [UnscoredRecord(self.job.scene, part.name, *pair) for pair in unscored.items()]
        write_text(folder.log, log.text(*not_scored_lines(reasons), "done"))
        predicted = folder.remarks("predict")
        doubts = predicted.get(REMARK, ())
        remarks = {"unscored": unscored, "warnings": list(dict.fromkeys(log.warnings)), REMARK: doubts}
        remarks["caveat"] = jobs.caveat_of(inputs.method, inputs.perception, inputs.info, predicted.get("clock"))
        remarks |= {"n_updates": n_updates, "n_seen": n_seen}
        folder.mark_complete("score", key, [*files, folder.log], remarks)

    def _score_seen(
        self, part: jobs.Part, inputs: jobs.JobInputs, folder: JobFolder, by_file: dict[Path, dict[str, SceneScore]]
    ) -> int:
        """Add the scores of each map, and of the ground truth, against what the frames until then have shown; return
        the number of these frames, 0 for a method without frames.

        The oracle's own map is at each point what all frames until then have shown.
        """
        is_oracle = isinstance(inputs.method, interfaces.UsesGroundTruth)
        if not self.job.config.seen_so_far or not (inputs.method.needs.frames or is_oracle):
            return 0
        self.report_activity(part, "finding what the frames show")
        shown, n = self.first_shown(part)
        if not shown:
            return 0
        ceiling = self.job.ceiling or next(one for one in self.job.methods if one.name == CEILING_METHOD)
        perfect, encoder = jobs.build_method(ceiling), inputs.perception.encoder
        perfect.receive_ground_truth(self.first_truth)
        for point, n_fed in (*self.job.config.anytime_points(n).items(), (None, n)):
            seen = {variant: [place < n_fed for place in places] for variant, places in shown.items()}
            own = folder.prediction if is_oracle or point is None else folder.anytime(point)
            refined_in = folder if point is None else None
            of_map, _ = self.scores(part, encoder, read_prediction(own), refined_in, seen)
            of_truth = of_map if part == ceiling else self.scores(ceiling, encoder, perfect.finish(), None, seen)[0]
            by_file[folder.curve_counts("seen", point)] = of_map
            by_file[folder.curve_counts("ceiling", point)] = of_truth
        return n

    def scores(
        self,
        part: jobs.Part,
        encoder: interfaces.Encoder,
        prediction: Prediction,
        refined_in: JobFolder | None,
        seen: Mapping[str, Sequence[BoolArray]] | None = None,
    ) -> tuple[dict[str, SceneScore], dict[str, str]]:
        """The scores under every protocol that can score the map, and why the others cannot.

        ``seen``: the points of each variant of the ground truth to which it is restricted.
        """
        scores: dict[str, SceneScore] = {}
        unscored: dict[str, str] = {}
        corruption = self.corruption(part)
        for n, rules in enumerate(map(load_protocol, self.job.protocols), 1):
            if rules.ground_truth not in self.truths:
                self.report_activity(part, "computing ground truth" if self.is_rendered else "reading ground truth")
            try:
                truth = self.truth(rules.ground_truth)
            except GroundTruthMissing as error:
                unscored[rules.name] = error_line(error)
                continue
            reason = None if seen is None else reason_against(rules)
            if (reason := reason or kind_incompatibility(rules, prediction)) is not None:
                unscored[rules.name] = reason
                continue
            self.report_activity(part, f"scoring {n} of {counted(len(self.job.protocols), 'protocol')}")
            known: Truth = self._truth_of(rules, truth, refined_in)
            base: Truth = truth
            if seen is not None:
                known, base = (restricted(one, seen[rules.ground_truth]) for one in (known, base))
            first = None if seen is not None else lambda: self.first_truth.labels
            configured = jobs.with_visible_truth(part, rules, base, prediction, first)
            names = tuple(rules.prompt_names.get(entry.name, entry.name) for entry in rules.classes)
            asked = rules.with_names(corruption.names(names)) if corruption and corruption.at("names") else rules
            # Points far outside what was seen, or under wrong poses, do not mean that the map is in another frame.
            score = score_located if seen is None and not part.corruption else score_scene
            scores[rules.name] = score(asked, known, configured, encoder)
        return scores, unscored

    def _truth_of(self, rules: ProtocolRules, truth: GroundTruth, refined_in: JobFolder | None) -> Truth:
        if not rules.asks:
            return truth
        refine = None if refined_in is None else partial(refined_names, refined_in)
        return question_truth(rules, self.dataset, self.job.scene_name, truth, refine, self.solver)
