"""Local files: atomic writes, locks, unpacking within limits, temporary folders."""
