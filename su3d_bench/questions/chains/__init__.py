"""Texts that lead to one object, several of each: made from a truth, read from Beacon3D's files, and scored."""
