"""Datasets and methods that are somebody's own: watched where they answer, and tried."""
