"""What the page of some runs holds: their numbers, and their maps scene after scene, made once and kept."""
