"""Comparison, regression checks, ranking and error attribution of finished runs."""
