"""Shared numerics: spatial relations, statistics, clustering and compiled kernels."""
