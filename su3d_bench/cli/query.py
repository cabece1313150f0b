"""``su3d-bench query text``: a text -> the instances of a map by similarity, and a heat map."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from su3d_bench.cli import ask, questions
from su3d_bench.cli.shared.answers import answer, answer_json, file_name_of, remark, remark_unseen, show
from su3d_bench.cli.shared.flags import add_group, add_verb, add_whose_map, check_scene_first
from su3d_bench.core.errors import ConfigError, PredictionError

if TYPE_CHECKING:
    from su3d_bench.core.maps import Instances
    from su3d_bench.questions.retrieval import Ranking


def add_parser(verbs: Any) -> None:
    actions = add_group(
        verbs,
        "query",
        "Ask the map of a scene for a text or a question, and make, show, audit or score sets of questions.",
        ('su3d-bench query text rooms/living0 "plant on shelf"', "su3d-bench query show paper"),
    )
    _add_text(actions)
    ask.add_parser(actions)
    questions.add_parser(actions)


def _add_text(actions: Any) -> None:
    parser = add_verb(
        actions,
        "text",
        "Rank the instances of a scene's map by their similarity to a text and draw the heat map.",
        (
            'su3d-bench query text rooms/living0 "plant on shelf"',
            'su3d-bench query text rooms/living0 "place to sit" --top 3 --method opensu3d --json',
        ),
        call,
    )
    parser.add_argument("scene", help="the scene's address, such as rooms/living0")
    parser.add_argument("text", help="what to look for")
    add_whose_map(parser)
    parser.add_argument("--top", type=int, default=10, metavar="N", help="how many instances to list (default: 10)")
    parser.add_argument("--device", default="cpu", help="of the text's encoder (default: cpu)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="where the picture goes (default: beside the map)")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.core.maps import DenseFeatures, Instances
    from su3d_bench.questions.retrieval import rank
    from su3d_bench.runs.finished import encoder_of, map_of_scene

    if not arguments.text.strip():
        raise ConfigError('the text is empty; say what to look for: su3d-bench query text rooms/living0 "a plant"')
    if arguments.top < 1:
        raise ConfigError(f"--top {arguments.top}: at least 1 instance must be listed")
    check_scene_first("query text", arguments.scene, arguments.text)
    run, job, prediction = map_of_scene(arguments.scene, arguments.method, arguments.run)
    if not isinstance(prediction, Instances):
        what = "one feature a point and no instances" if isinstance(prediction, DenseFeatures) else "no instances"
        raise PredictionError(f"{job.prediction}: has {what}, so there is nothing to rank; choose another --method")
    encoder = encoder_of(run, arguments.device)
    ranking = rank(prediction, arguments.text, encoder)
    rows = _rows(prediction, ranking, arguments.top)
    picture = arguments.out or job.picture(f"query-{file_name_of(arguments.text, 'text')}.png")
    remark_unseen(encoder, arguments.text, quiet=arguments.quiet)
    if not arguments.json:
        wide = max([4, *(len(str(row["id"])) for row in rows)])
        answer(f"{'rank':>4}  {'id':>{wide}}  {'similarity':>10}  {'centroid (m)':<22}  name")
        for row in rows:
            x, y, z = row["centroid"]
            place = f"{x:7.2f}{y:7.2f}{z:7.2f}"
            answer(f"{row['rank']:>4}  {row['id']:>{wide}}  {row['similarity']:>10.3f}  {place:<22}  {row['name']}")
        show()  # the picture takes longer than the answer
    _draw(prediction, ranking, rows, picture, f'{arguments.scene}: "{arguments.text}"')
    value = {"scene": arguments.scene, "text": arguments.text, "picture": str(picture), "ranking": rows}
    if not answer_json(arguments, value):
        remark(f"heat map: {picture}", quiet=arguments.quiet)
    return 0


def _draw(instances: Instances, ranking: Ranking, rows: list[dict[str, Any]], picture: Path, title: str) -> None:
    from su3d_bench.reports.pictures.maps import draw_heat_map

    lines = [f"{row['rank']}. {row['name']}  {row['similarity']:.3f}" for row in rows]
    draw_heat_map(instances, ranking.similarity, picture, title, lines)


def _rows(instances: Instances, ranking: Ranking, top: int) -> list[dict[str, Any]]:
    rows = []
    for place, k in enumerate(ranking.order[:top], start=1):
        rows.append(
            {
                "rank": place,
                "id": int(instances.ids[k]) if len(instances.ids) else int(k),
                "name": instances.names[k],
                "similarity": float(ranking.similarity[k]),
                "centroid": [float(value) for value in instances.centroids[k]],
            }
        )
    return rows
