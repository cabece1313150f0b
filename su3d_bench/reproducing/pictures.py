"""The heat maps of a paper's figures: every instance of a map by its similarity to a text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from su3d_bench.core.files.atomic import is_file, make_folder
from su3d_bench.core.maps import Instances
from su3d_bench.questions.retrieval import rank
from su3d_bench.reports.pictures.maps import draw_heat_map
from su3d_bench.reproducing.asked import methods_of
from su3d_bench.reproducing.differences import Results
from su3d_bench.reproducing.recipe import Experiment
from su3d_bench.runs.finished import FinishedRun, encoder_of
from su3d_bench.store.predictions import read_prediction

SHOWN = 5  # instances that are listed beneath a picture


def draw_queries(experiments: Sequence[Experiment], results: Results, out: Path, device: str) -> Iterator[Path]:
    """A picture a text and method, of the first scene of the run; maps without instances have none."""
    for experiment in experiments:
        if not experiment.queries:
            continue
        for run in results.of(experiment).runs.values():
            if experiment.queries and set(methods_of(experiment)) <= set(run.methods):
                yield from _of_run(experiment, run, out / experiment.name, device)
                break


def _of_run(experiment: Experiment, run: FinishedRun, out: Path, device: str) -> Iterator[Path]:
    names = [scene for scene in run.scenes if scene in experiment.scenes] or list(run.scenes[:1])
    encoder = encoder_of(run.folder, device)
    make_folder(out)
    for scene in names[:1]:
        for method in methods_of(experiment):
            file = run.folder.job(scene, method).prediction
            prediction = read_prediction(file) if is_file(file) else None
            if not isinstance(prediction, Instances):
                continue
            for text in experiment.queries:
                ranking = rank(prediction, text, encoder)
                first = [(prediction.names[k], float(ranking.similarity[k])) for k in ranking.order[:SHOWN]]
                lines = [f"{place}. {name}  {value:.3f}" for place, (name, value) in enumerate(first, 1)]
                picture = out / f"{text.replace(' ', '-')}-{method.replace('@', '-')}.png"
                draw_heat_map(prediction, ranking.similarity, picture, f'{scene}, {method}: "{text}"', lines)
                yield picture
