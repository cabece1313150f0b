"""The inventory of what reads files and texts of others: tests and ``python benchmarks fuzz`` damage every row."""

from __future__ import annotations

import fuzz_targets_counts
import fuzz_targets_datasets
import fuzz_targets_fetching
import fuzz_targets_perception
import fuzz_targets_predictions
import fuzz_targets_runs

TARGETS = {
    one.name: one
    for one in (
        *fuzz_targets_counts.TARGETS,
        *fuzz_targets_datasets.TARGETS,
        *fuzz_targets_fetching.TARGETS,
        *fuzz_targets_perception.TARGETS,
        *fuzz_targets_predictions.TARGETS,
        *fuzz_targets_runs.TARGETS,
    )
}
