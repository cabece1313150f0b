"""Reproduction of a paper's experiments from recipes: requirements, runs, measured and reported numbers, bundles."""
