"""Words that taggers give and that name no object, as ConceptGraphs sorts them (generate_gsa_results.py, 5c4da70)."""

from __future__ import annotations

# A tag that contains one of these is left out.
STOP_WORDS = (
    "room", "kitchen", "office", "house", "home", "building", "corner", "shadow", "carpet", "photo", "shade", "stall",
    "space", "aquarium", "apartment", "image", "city", "blue", "skylight", "hallway", "bureau", "modern", "salon",
    "doorway", "wall lamp", "wood floor",
)  # fmt: skip
# Asked for in every image besides its tags.
ADDED_TAGS = ("other item",)
# Added with --add_bg_classes.
BACKGROUND_TAGS = ("wall", "floor", "ceiling")
