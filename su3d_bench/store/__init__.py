"""Atomic storage on disk: run folders, their records, predictions, caches."""
