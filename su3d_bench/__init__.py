"""Evaluation and benchmarking of open-vocabulary, instance-level 3D scene understanding from RGB-D."""

__version__ = "0.1.0"
