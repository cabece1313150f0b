"""Questions about a map: by geometry alone, or by a language model that is given the map."""
