"""Geometry, statistics, clusters, grids of cells and compiled loops that several folders use."""
