"""Placeholders in a command, such as ``{scene}``: where their values may be inserted.

Dataset folders may have malicious names, such as ``x$(touch y)``. A value is never inserted into code: it is passed as
an argument or in the environment; a shell line gets the variable instead.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import PurePath

PLACEHOLDER = re.compile(r"\{(\w*)\}")
PLACEHOLDERS = ("frames", "output", "work", "scene", "dataset", "seed")
BESIDE = re.compile(r"[\w./:=,@%+~\[\]-]*")  # characters allowed in one word with a placeholder: no code
INTERPRETER = re.compile(
    r"(ba|da|a|z|k|mk|fi|c|tc)?sh|busybox|su|runuser|script|flock|(python|pypy|perl|ruby|lua|php)[\d.]*|node|nodejs|deno"
    r"|bun|R|Rscript|luajit|julia|octave"
)
WITH_A_VALUE = re.compile(r"-[OWX]|-[a-z]*o")  # interpreter options whose value may be a separate word
CODE_OPTION = re.compile(r"-[A-Za-z]*[ceEpr]|--(eval|command|print|execute)=?")  # followed by a program


def variable_of(name: str) -> str:
    """The environment variable that holds the value of a placeholder.

    >>> variable_of("scene")
    'SU3D_SCENE'
    """
    return f"SU3D_{name.upper()}"


def check_placeholders(command: str | Sequence[str], *, is_shell: bool) -> None:
    """Raises ``ValueError`` for an unknown placeholder, or one whose value would be read as code."""
    if isinstance(command, str) and is_shell:
        for name in _misplaced(command):
            right = f'write {{{name}}} outside of quotes, or "${variable_of(name)}"'
            raise ValueError(f"'{{{name}}}' is where a shell would read its value as commands; {right}")
        return
    words = shlex.split(command) if isinstance(command, str) else command
    for k, word in enumerate(words):
        names = [name for name in PLACEHOLDER.findall(word) if name]
        if not names:
            continue
        if unknown := [name for name in names if name not in PLACEHOLDERS]:
            raise ValueError(f"'{{{unknown[0]}}}' is an unknown placeholder; known: {{{'}, {'.join(PLACEHOLDERS)}}}")
        if not BESIDE.fullmatch(PLACEHOLDER.sub("", word)) or _is_code(words, k):
            raise ValueError(
                f"'{{{names[0]}}}' is inside text that may be read as code; make it a separate argument, or use "
                f"the environment variable {variable_of(names[0])} there"
            )


def _misplaced(line: str) -> Iterator[str]:
    """The placeholders of a shell line whose value would be read as commands, or fed to a shell."""
    for found in PLACEHOLDER.finditer(line):
        before = line[: found.start()]
        unescaped = re.sub(r"\\.|(?:^|\s)#[^\n]*", "", before)
        is_quoted = unescaped.count("'") % 2 or unescaped.count('"') % 2
        if found[1] in PLACEHOLDERS and (is_quoted or "<<" in before or before.endswith(("$", "\\"))):
            yield found[1]


def _is_code(words: Sequence[str], k: int) -> bool:
    """Whether an interpreter reads the ``k``-th word (preceded only by its options) as a program."""
    for start in (n for n in range(k) if INTERPRETER.fullmatch(PurePath(words[n]).name)):
        between = words[start + 1 : k]
        are_options = all(
            word.startswith(("-", "+")) or (n > 0 and WITH_A_VALUE.fullmatch(between[n - 1]))
            for n, word in enumerate(between)
        )
        options = [*between, PLACEHOLDER.split(words[k])[0]]
        if are_options and any(CODE_OPTION.fullmatch(option) for option in options):
            return True
    return False
