"""Protocols: their files, the rules that these hold, and how rules are found by name."""
