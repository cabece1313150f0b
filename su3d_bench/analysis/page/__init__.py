"""The contents of the HTML report of runs: their numbers, and their maps per scene, computed once and cached."""
