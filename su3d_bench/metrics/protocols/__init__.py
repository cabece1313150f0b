"""Protocols: their files, the rules in them, and lookup by name."""
