"""English nouns in questions and names: one and several of a thing, articles, words that are compared.

The tokenizer of the embedded text tower reduces plurals too, but roughly, and its trained weights hold it to that; what
is asked and understood goes by these words.
"""

from __future__ import annotations

import re

from su3d_bench.perception.embedded import naming

IRREGULAR = {
    "person": "people", "man": "men", "woman": "women", "child": "children", "foot": "feet", "tooth": "teeth",
    "mouse": "mice", "goose": "geese", "die": "dice", "knife": "knives", "life": "lives", "wife": "wives",
    "shelf": "shelves", "half": "halves", "calf": "calves", "wolf": "wolves", "leaf": "leaves", "loaf": "loaves",
    "scarf": "scarves", "thief": "thieves", "hoof": "hooves", "elf": "elves", "potato": "potatoes",
    "tomato": "tomatoes", "hero": "heroes", "echo": "echoes", "movie": "movies", "cookie": "cookies", "pie": "pies",
    "tie": "ties", "quiz": "quizzes", "axis": "axes", "ox": "oxen",
}  # fmt: skip
_SINGULAR = {several: one for one, several in IRREGULAR.items()}
# Things of two parts, or many: one of them is called as several are.
ALWAYS_PLURAL = frozenset(
    ("blinds", "clothes", "curtains", "glasses", "goggles", "headphones", "jeans", "pants", "pyjamas", "pajamas",
     "scissors", "shears", "shorts", "stairs", "tongs", "trousers", "tweezers")
)  # fmt: skip
# Stuff, of which there are not two.
UNCOUNTABLE = frozenset(
    ("bedding", "bread", "clothing", "cutlery", "equipment", "flooring", "food", "furniture", "hair", "jewelry",
     "laundry", "luggage", "otherfurniture", "paper", "rubbish", "trash", "water", "wood", "wine", "toilet paper",
     "tissue paper")
)  # fmt: skip
# Words that end in "as" or "es" and mean one.
_ONE_IN_S = frozenset(("atlas", "bias", "canvas", "christmas", "gas", "lens", "series", "species"))
_ENDS_IN_USE = frozenset(("house", "greenhouse", "dollhouse", "birdhouse", "mouse", "blouse", "fuse", "cause"))
_ARTICLES = frozenset(("a", "an", "the"))
_WORD = re.compile(r"[a-z0-9]+")


def words(text: str) -> tuple[str, ...]:
    """The lower-case words of a name or noun phrase, without articles, each as one of the thing is called.

    >>> words("The two sofas"), words("indoor-plants"), words("a canvas")
    (('two', 'sofa'), ('indoor', 'plant'), ('canvas',))
    """
    parts = _WORD.findall(text.lower().replace("'", "").replace("’", ""))
    return tuple(singular(word) for word in parts if word not in _ARTICLES)


def last_word(name: str) -> str:
    """The noun of a name, which says what it is: "paper towel" is a towel."""
    return (words(name) or ("",))[-1]


def singular(word: str) -> str:
    """What one of several is called; a word that means one stays.

    >>> [singular(word) for word in ("sofas", "vases", "buses", "bookshelves", "stoves", "glass", "cookies", "candies")]
    ['sofa', 'vase', 'bus', 'bookshelf', 'stove', 'glass', 'cookie', 'candy']
    """
    if not word.endswith("s") and word not in _SINGULAR:
        return word
    for several, one in _SINGULAR.items():
        if word == several or (len(several) > 4 and word.endswith(several)):
            return word[: -len(several)] + one
    is_short = len(word) < 3 or (len(word) == 3 and word[1] in "aeiou")
    if is_short or word.endswith(("ss", "us", "is")) or word in _ONE_IN_S:
        return word
    if word.endswith("ies"):
        return word[:-3] + "y"
    if word.endswith(("sses", "shes", "ches", "xes", "zzes", "uses")) and word[:-1] not in _ENDS_IN_USE:
        return word[:-2]
    return word[:-2] if word.endswith("es") and word[:-2] in _ONE_IN_S else word[:-1]


def plural(name: str) -> str:
    """What several things of a name are called; what is called as several are already stays.

    >>> [plural(name) for name in ("sofa", "knife block", "bus", "case of water bottles", "blinds", "candy")]
    ['sofas', 'knife blocks', 'buses', 'cases of water bottles', 'blinds', 'candies']
    """
    head, of, rest = name.partition(" of ")
    before, blank, word = head.rpartition(" ")
    return f"{before}{blank}{_plural_word(word)}{of}{rest}"


def _plural_word(word: str) -> str:
    if word in ALWAYS_PLURAL or word in UNCOUNTABLE or singular(word) != word:
        return word
    for one, several in IRREGULAR.items():
        if word == one or (len(one) > 3 and word.endswith(one)):
            return word[: -len(one)] + several
    if word.endswith(("s", "x", "z", "ch", "sh")):
        return f"{word}es"
    return f"{word[:-1]}ies" if word.endswith("y") and word[-2:-1] not in tuple("aeiou") else f"{word}s"


def is_countable(name: str) -> bool:
    """Whether one asks how many there are."""
    return name not in UNCOUNTABLE and name.rpartition(" ")[2] not in UNCOUNTABLE


def is_plural(name: str) -> bool:
    """Whether one thing of this name is spoken of as of several: "which blinds are"."""
    head = name.partition(" of ")[0].rpartition(" ")[2]
    return head in ALWAYS_PLURAL or singular(head) != head


def with_article(noun: str) -> str:
    """A noun after "a" or "an"; names that mean several stand alone.

    >>> with_article("indoor plant"), with_article("utensil holder"), with_article("blinds")
    ('an indoor plant', 'a utensil holder', 'blinds')
    """
    first = noun.strip().lower()
    return noun if is_plural(first) or not is_countable(first) else naming.with_article(noun)
