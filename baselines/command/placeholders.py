"""What stands for a value in a command, and where it must not: no value is ever read as a part of a program.

Folders of datasets have names that others chose, such as ``x$(touch y)``. A value reaches the program as a word, or
through its environment; a shell's line gets the variable in the place of the value.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import PurePath

PLACEHOLDER = re.compile(r"\{(\w*)\}")
PLACEHOLDERS = ("frames", "output", "work", "scene", "dataset", "seed")
# Programs that take a program as a word behind an option, with the letters of that option.
INTERPRETERS = (
    (re.compile(r"(ba|da|a|z|k|mk|fi|c|tc)?sh|busybox|su|runuser|script|flock|python[\d.]*|pypy[\d.]*"), "c"),
    (
        re.compile(r"perl[\d.]*|ruby[\d.]*|node|nodejs|deno|bun|R|Rscript|lua[\d.]*|luajit|julia|octave|php[\d.]*"),
        "eEpr",
    ),
)
WITH_A_VALUE = re.compile(r"-[OWX]|-[a-z]*o")  # options of interpreters whose value may be a word of its own


def variable_of(name: str) -> str:
    """The environment variable that holds the value of a placeholder.

    >>> variable_of("scene")
    'SU3D_SCENE'
    """
    return f"SU3D_{name.upper()}"


def words_of(command: str | Sequence[str]) -> list[str]:
    """The words of a command; what a shell alone can split is split at spaces."""
    if not isinstance(command, str):
        return list(command)
    try:
        return shlex.split(command)
    except ValueError:
        return command.split()


def check_placeholders(command: str | Sequence[str], *, is_shell: bool) -> None:
    """A ``ValueError`` where a placeholder stands for nothing, or where its value would be read as a program."""
    if isinstance(command, str) and is_shell:
        for name, place in _misplaced(command):
            right = f'write {{{name}}} outside of quotes, or "${variable_of(name)}"'
            raise ValueError(f"'{{{name}}}' stands {place}, where a shell would read its value as commands; {right}")
        return
    words = shlex.split(command) if isinstance(command, str) else command
    unknown = [name for word in words for name in PLACEHOLDER.findall(word) if name and name not in PLACEHOLDERS]
    if unknown:
        raise ValueError(f"'{{{unknown[0]}}}' stands for nothing; known: {{{'}, {'.join(PLACEHOLDERS)}}}")
    for program, code in _programs_in(words):
        names = [name for name in PLACEHOLDER.findall(code) if name]
        if names:
            raise ValueError(
                f"'{{{names[0]}}}' stands within a program for '{program}', which would read its value as code; use "
                f"the environment variable {variable_of(names[0])} there"
            )


def _misplaced(line: str) -> Iterator[tuple[str, str]]:
    """The placeholders of a shell's line that do not stand as a word or a part of one, and where they stand.

    What is mistaken here costs quotes and no more: the shell never sees a value.
    """
    quote, is_in_word, has_here_document, at = "", False, False, 0
    while at < len(line):
        character = line[at]
        found = PLACEHOLDER.match(line, at)
        if found is not None and found[1] in PLACEHOLDERS:
            place = "within quotes" if quote else "behind a $" if line[at - 1 : at] == "$" else ""
            place = place or ("behind a \\" if line[at - 1 : at] == "\\" else "")
            place = place or ("in or after a here-document" if has_here_document else "")
            if place:
                yield found[1], place
            at = found.end()
            is_in_word = True
            continue
        if quote:
            at += 1 + (character == "\\" and quote == '"' and line[at + 1 : at + 2] in tuple('\\"$`'))
            quote = "" if character == quote else quote
            continue
        if character == "#" and not is_in_word:
            end = line.find("\n", at)
            at = len(line) if end < 0 else end
            continue
        has_here_document = has_here_document or line.startswith("<<", at)
        is_in_word = character not in " \t\n;&|()`"
        quote = character if character in "'\"" else ""
        at += 1 + (character == "\\" and PLACEHOLDER.match(line, at + 1) is None)


def _programs_in(words: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Interpreters in ``words`` with the words that each reads as a program."""
    for k, word in enumerate(words):
        name = PurePath(word).name
        letters = next((letters for pattern, letters in INTERPRETERS if pattern.fullmatch(name)), "")
        if letters:
            yield from ((name, code) for code in _code_behind(words[k + 1 :], letters))


def _code_behind(words: Sequence[str], letters: str) -> Iterator[str]:
    is_code = is_value = False
    for word in words:
        if word.startswith(("-", "+")):
            if re.match(rf"-[A-Za-z]*[{letters}]|--(eval|command|print|execute)\b", word):
                yield word  # its code may follow without a space
                is_code = True
            is_value = bool(WITH_A_VALUE.fullmatch(word))
        elif is_value:
            is_value = False
        else:
            if is_code:
                yield word
            return
