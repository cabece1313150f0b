"""The vocabulary of the rooms: classes with Replica's ids and names, colours, materials, affordances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

SIT, LIE = "place to sit", "place to sleep"
STORE, DISPLAY = "place to store things", "something to decorate the room"


@dataclass(frozen=True)
class RoomClass:
    """One class: ``id`` and ``name`` as in Replica's info_semantic.json; what it may be made of; what it is for."""

    id: int
    name: str
    materials: tuple[str, ...]
    colours: tuple[str, ...]
    affordances: tuple[str, ...] = ()


# sRGB; every instance departs from these a little
COLOUR_RGB: Mapping[str, tuple[int, int, int]] = {
    "red": (188, 38, 38),
    "green": (58, 140, 62),
    "blue": (48, 88, 182),
    "yellow": (228, 192, 48),
    "orange": (228, 118, 36),
    "purple": (122, 62, 152),
    "pink": (232, 138, 166),
    "brown": (118, 74, 42),
    "black": (36, 36, 39),
    "white": (236, 234, 229),
    "grey": (136, 137, 140),
    "beige": (214, 192, 156),
}
COLOURS = tuple(COLOUR_RGB)
MATERIALS = ("wooden", "metal", "plastic", "fabric", "leather", "ceramic", "glass", "stone", "paper", "wicker")

_BRIGHT = ("red", "green", "blue", "yellow", "orange", "purple", "pink")
_ANY = COLOURS
_WOOD = ("brown", "beige", "black", "white", "grey")
_SOFT = (*_BRIGHT, "beige", "grey", "brown", "white")
_TECH = ("black", "white", "grey")

CLASSES: tuple[RoomClass, ...] = (
    RoomClass(93, "wall", ("stone",), ("white", "beige", "grey", "yellow", "green", "blue", "pink")),
    RoomClass(40, "floor", ("wooden", "stone"), ("brown", "beige", "grey", "white")),
    RoomClass(31, "ceiling", ("stone",), ("white",)),
    RoomClass(37, "door", ("wooden",), ("white", "brown", "beige", "grey"), ("way to leave the room",)),
    RoomClass(97, "window", ("glass",), ("white", "brown", "grey"), ("something to look outside",)),
    RoomClass(7, "bed", ("wooden",), ("brown", "beige", "white", "black"), (LIE, "place to lie down")),
    RoomClass(76, "sofa", ("fabric", "leather"), _SOFT, (SIT, "place to relax")),
    RoomClass(20, "chair", ("wooden", "plastic"), (*_WOOD, "red", "blue", "green", "yellow", "orange"), (SIT,)),
    RoomClass(8, "bench", ("wooden",), _WOOD, (SIT,)),
    RoomClass(78, "stool", ("wooden", "metal"), (*_WOOD, "red", "blue"), (SIT,)),
    RoomClass(6, "beanbag", ("fabric",), _SOFT, (SIT, "place to relax")),
    RoomClass(80, "table", ("wooden",), _WOOD, ("place to eat",)),
    RoomClass(34, "desk", ("wooden",), _WOOD, ("place to work",)),
    RoomClass(54, "nightstand", ("wooden",), _WOOD, (STORE,)),
    RoomClass(18, "cabinet", ("wooden",), (*_WOOD, "green", "blue"), (STORE,)),
    RoomClass(2, "base-cabinet", ("wooden",), ("white", "beige", "grey", "green", "blue", "brown"), (STORE,)),
    RoomClass(94, "wall-cabinet", ("wooden",), ("white", "beige", "grey", "green", "blue", "brown"), (STORE,)),
    RoomClass(33, "countertop", ("stone",), ("grey", "black", "white", "beige"), ("place to prepare food",)),
    RoomClass(96, "wardrobe", ("wooden",), _WOOD, ("place to hang clothes", STORE)),
    RoomClass(71, "shelf", ("wooden", "metal"), (*_WOOD,), (STORE,)),
    RoomClass(88, "tv-stand", ("wooden",), _WOOD, (STORE,)),
    RoomClass(47, "lamp", ("fabric", "metal"), ("white", "beige", "yellow", "red", "green", "blue", "orange"),
              ("source of light",)),
    RoomClass(87, "tv-screen", ("plastic",), ("black",), ("something to watch films",)),
    RoomClass(52, "monitor", ("plastic",), _TECH, ("something to see the computer's picture",)),
    RoomClass(27, "computer-keyboard", ("plastic",), _TECH, ("something to type with",)),
    RoomClass(53, "mouse", ("plastic",), (*_TECH, "red", "blue"), ("something to move the pointer",)),
    RoomClass(48, "laptop", ("metal", "plastic"), _TECH, ("something to type with", "computer to carry")),
    RoomClass(36, "desktop-computer", ("metal",), ("black", "white", "grey"), ("machine to compute",)),
    RoomClass(67, "refrigerator", ("metal",), ("white", "grey", "black", "red"), ("place to keep food cold",)),
    RoomClass(32, "cooktop", ("glass",), ("black",), ("place to cook",)),
    RoomClass(51, "microwave", ("metal",), ("black", "white", "grey", "red"), ("something to heat food",)),
    RoomClass(74, "sink", ("ceramic", "metal"), ("white", "grey"), ("place to wash hands",)),
    RoomClass(84, "toilet", ("ceramic",), ("white", "beige", "pink"), ("place to relieve oneself",)),
    RoomClass(4, "bathtub", ("ceramic",), ("white", "beige", "pink"), ("place to bathe",)),
    RoomClass(86, "towel", ("fabric",), (*_BRIGHT, "white", "grey", "beige"), ("something to dry hands",)),
    RoomClass(50, "mat", ("fabric",), (*_BRIGHT, "grey", "brown"), ("something to wipe feet",)),
    RoomClass(57, "paper-towel", ("paper",), ("white",), ("something to wipe up spills",)),
    RoomClass(83, "tissue-paper", ("paper",), (*_BRIGHT, "white"), ("something to blow the nose",)),
    RoomClass(55, "pan", ("metal",), ("black", "grey", "red"), ("something to fry with",)),
    RoomClass(65, "pot", ("metal",), ("grey", "red", "orange", "blue", "green", "yellow"), ("something to boil with",)),
    RoomClass(64, "plate", ("ceramic",), (*_BRIGHT, "white", "beige"), ("something to eat from",)),
    RoomClass(16, "bowl", ("ceramic",), (*_BRIGHT, "white", "beige"), ("something to eat from",)),
    RoomClass(28, "cup", ("ceramic",), (*_BRIGHT, "white", "black"), ("something to drink from",)),
    RoomClass(14, "bottle", ("glass", "plastic"), ("green", "brown", "blue", "red", "orange", "white"),
              ("something that holds a drink",)),
    RoomClass(21, "chopping-board", ("wooden",), ("beige", "brown"), ("something to cut food on",)),
    RoomClass(45, "knife-block", ("wooden",), ("brown", "beige", "black"), ("something that holds knives",)),
    RoomClass(91, "vase", ("ceramic", "glass"), (*_BRIGHT, "white", "black"), (DISPLAY,)),
    RoomClass(44, "indoor-plant", ("ceramic",), ("green",), (DISPLAY, "something to water")),
    RoomClass(63, "plant-stand", ("metal", "wooden"), ("black", "brown", "white", "beige"),
              ("something that holds a plant",)),
    RoomClass(59, "picture", ("paper",), ("black", "white", "brown", "yellow"), (DISPLAY,)),
    RoomClass(70, "sculpture", ("stone", "metal"), ("white", "grey", "black", "brown", "yellow"), (DISPLAY,)),
    RoomClass(22, "clock", ("plastic", "metal"), (*_BRIGHT, "black", "white", "brown"),
              ("something to read the time",)),
    RoomClass(19, "candle", ("plastic",), ("white", "red", "yellow", "purple", "green", "beige"), (DISPLAY,)),
    RoomClass(29, "cushion", ("fabric",), _SOFT, ("something soft to lean on",)),
    RoomClass(61, "pillow", ("fabric",), ("white", "beige", "blue", "pink", "grey"),
              ("something to rest the head on",)),
    RoomClass(11, "blanket", ("fabric",), _SOFT, ("something to keep warm",)),
    RoomClass(98, "rug", ("fabric",), _SOFT, ("something soft to stand on",)),
    RoomClass(30, "curtain", ("fabric",), _SOFT, ("something to darken the room",)),
    RoomClass(12, "blinds", ("plastic", "wooden"), ("white", "beige", "brown", "grey"),
              ("something to darken the room",)),
    RoomClass(13, "book", ("paper",), (*_BRIGHT, "brown", "black"), ("something to read",)),
    RoomClass(15, "box", ("paper", "plastic"), ("brown", "beige", "blue", "red", "green", "white"), (STORE,)),
    RoomClass(3, "basket", ("wicker",), ("brown", "beige", "white", "grey"), (STORE,)),
    RoomClass(10, "bin", ("plastic", "metal"), ("black", "grey", "white", "red", "green", "blue"),
              ("place to throw trash",)),
    RoomClass(1, "backpack", ("fabric",), (*_BRIGHT, "black", "grey"), ("something to carry things in",)),
    RoomClass(38, "exercise-ball", ("plastic",), _BRIGHT, ("something to exercise with",)),
    RoomClass(89, "umbrella", ("fabric",), (*_BRIGHT, "black"), ("something to stay dry in the rain",)),
    RoomClass(79, "switch", ("plastic",), ("white", "black", "beige"), ("something to turn the light on",)),
    RoomClass(95, "wall-plug", ("plastic",), ("white", "black", "beige"), ("something to charge a phone",)),
    RoomClass(92, "vent", ("metal",), ("white", "grey"), ("something that lets air in",)),
)  # fmt: skip
CLASS_BY_NAME: Mapping[str, RoomClass] = {known.name: known for known in CLASSES}
CLASS_ID: Mapping[str, int] = {known.name: known.id for known in CLASSES}
AFFORDANCES: Mapping[str, tuple[str, ...]] = {known.name: known.affordances for known in CLASSES}
