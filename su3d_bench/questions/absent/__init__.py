"""Things that a scene has not and that are asked for all the same."""
