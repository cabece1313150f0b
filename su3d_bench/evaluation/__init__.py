"""``evaluate``: predictions made elsewhere to numbers."""
