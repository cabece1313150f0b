"""Benchmarks use what tests share: the made scenes and the devices of torch."""

from __future__ import annotations

import shared_with_tests  # noqa: F401
