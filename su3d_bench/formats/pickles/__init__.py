"""Pickles of other programs read as plain data, by an interpreter that imports and calls nothing."""
