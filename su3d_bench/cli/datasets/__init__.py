"""``su3d-bench datasets``: what is here, whether it is whole, how it looks, and making what is not."""

from __future__ import annotations

from typing import Any

from su3d_bench.cli.datasets import list as datasets_list


def add_parser(verbs: Any) -> None:
    datasets_list.add_parser(verbs)
