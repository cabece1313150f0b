"""Questions about a scene and their answers, if known."""
