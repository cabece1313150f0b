"""Readers for untrusted files: no code in them is executed, and their declared sizes are checked."""
