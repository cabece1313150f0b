"""Finished runs compared, gated, ranked and taken apart."""
