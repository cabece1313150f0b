"""Predictions made elsewhere: readers of the formats in which other programs leave their results."""
