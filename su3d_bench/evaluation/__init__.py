"""``evaluate``: score external predictions."""
