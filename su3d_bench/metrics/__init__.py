"""Metrics: ``per_scene`` gives additive counts, ``combine`` turns counts into ratios; no I/O."""
