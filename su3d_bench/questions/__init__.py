"""Questions about a scene and their answers where known."""
