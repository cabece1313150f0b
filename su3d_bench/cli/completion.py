"""``su3d-bench completion``: a script for a shell that completes verbs, flags and choices, made from the parser."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from su3d_bench.cli.shared.answers import answer_either
from su3d_bench.cli.shared.flags import add_verb
from su3d_bench.core.errors import EXIT_DONE

SHELLS = ("bash", "zsh", "fish")
HOW = {
    "bash": 'eval "$(su3d-bench completion bash)"  # in ~/.bashrc',
    "zsh": 'eval "$(su3d-bench completion zsh)"  # in ~/.zshrc, below compinit',
    "fish": "su3d-bench completion fish | source  # in ~/.config/fish/config.fish",
}
_CHOICES = re.compile(r"[\w-]+(\|[\w-]+)+")  # a metavar that names them, such as list|show


@dataclass(frozen=True)
class Verb:
    """What may follow the words ``path``: verbs, flags with their help, the choices of flags and of the first word.

    ``several`` are the flags of ``choices`` that take more than one.
    """

    path: str
    words: tuple[str, ...] = ()
    flags: dict[str, str] = field(default_factory=dict)
    choices: dict[str, tuple[str, ...]] = field(default_factory=dict)
    several: frozenset[str] = frozenset()


def add_parser(verbs: Any) -> None:
    parser = add_verb(
        verbs,
        "completion",
        "Print a script that completes verbs, flags and choices in a shell.",
        ('eval "$(su3d-bench completion bash)"', "su3d-bench completion fish"),
        call,
    )
    parser.add_argument("shell", choices=SHELLS, help="whose script: bash, zsh or fish")


def call(arguments: argparse.Namespace) -> int:
    from su3d_bench.cli.main import build_parser

    known = list(verbs_of(build_parser()))
    script = {"bash": bash, "zsh": zsh, "fish": fish}[arguments.shell](known)
    lines = [f"# {HOW[arguments.shell]}", *script] if arguments.shell != "zsh" else script
    answer_either(arguments, {"shell": arguments.shell, "script": "\n".join(lines) + "\n"}, *lines)
    return EXIT_DONE


def verbs_of(parser: argparse.ArgumentParser, path: str = "") -> Iterator[Verb]:
    """Every verb below ``parser``, that itself first; flags without help are not shown."""
    words: list[str] = []
    flags: dict[str, str] = {}
    choices: dict[str, tuple[str, ...]] = {}
    several = set()
    deeper: dict[str, argparse.ArgumentParser] = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            deeper = dict(action.choices)
            words += deeper
        elif not action.option_strings:
            words += [] if words else _choices(action)
        elif action.help != argparse.SUPPRESS:
            for name in action.option_strings:
                flags[name] = (action.help or "").replace("%%", "%")
                if given := _choices(action):
                    choices[name] = given
                    several |= {name} if action.nargs in ("+", "*") else set()
    yield Verb(path, tuple(words), flags, choices, frozenset(several))
    for name, below in deeper.items():
        yield from verbs_of(below, f"{path} {name}".strip())


def _choices(action: argparse.Action) -> tuple[str, ...]:
    if action.choices:
        return tuple(map(str, action.choices))
    metavar = action.metavar if isinstance(action.metavar, str) else ""
    return tuple(metavar.split("|")) if _CHOICES.fullmatch(metavar) else ()


def quoted(text: str) -> str:
    """``text`` as one word of bash and zsh, whatever it holds.

    >>> quoted("it's") == "'it'" + chr(92) + "''s'"
    True
    """
    return "'" + text.replace("'", "'\\''") + "'"


def quoted_for_fish(text: str) -> str:
    """``text`` as one word of fish, whatever it holds.

    >>> quoted_for_fish("it's") == "'it" + chr(92) + "'s'"
    True
    """
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


# bash and zsh: ``verb`` becomes the verb's words, ``flag`` the last flag, ``near`` that flag if nothing stands between
# it and the word that is completed, ``given`` what stands before all flags; then ``found`` holds the words that may
# follow, none where files may.


def bash(verbs: Sequence[Verb]) -> list[str]:
    """The script for bash 3.2 and later."""
    return [
        "_su3d_bench() {",
        "  local current=${COMP_WORDS[COMP_CWORD]} verb='' flag='' near='' given='' word='' i found",
        "  for ((i = 1; i < COMP_CWORD; i++)); do",
        "    word=${COMP_WORDS[i]}",
        *_reading(verbs),
        "  done",
        *_finding(verbs),
        "  COMPREPLY=()",
        '  for word in "${found[@]}"; do',
        '    case $word in "$current"*) COMPREPLY+=("$word") ;; esac',
        "  done",
        "}",
        "complete -o bashdefault -o default -F _su3d_bench su3d-bench",
    ]


def zsh(verbs: Sequence[Verb]) -> list[str]:
    """The script for zsh, to be evaluated or to lie in a folder of ``fpath`` as ``_su3d-bench``."""
    return [
        "#compdef su3d-bench",
        f"# {HOW['zsh']}",
        "_su3d_bench() {",
        "  local current=${words[CURRENT]} verb='' flag='' near='' given='' word='' i found",
        "  for ((i = 2; i < CURRENT; i++)); do",
        "    word=${words[i]}",
        *_reading(verbs),
        "  done",
        *_finding(verbs),
        '  if (( ${#found} )); then compadd -- "${found[@]}"; else _files; fi',
        "}",
        'if [ "${funcstack[1]}" = _su3d-bench ]; then _su3d_bench "$@"; else compdef _su3d_bench su3d-bench; fi',
    ]


def _reading(verbs: Sequence[Verb]) -> list[str]:
    """Lines that take one ``word`` before the place that is completed."""
    paths = [quoted(f"{path} {name}".strip()) for path, name in _steps(verbs)]
    longer = '"${verb:+$verb }$word"'
    return [
        '    case "$word" in -*) flag=$word near=$word; continue ;; esac',
        "    near=''",
        f"    case {longer} in {'|'.join(paths)}) verb={longer} flag='' ;; *) given=$word ;; esac",
    ]


def _steps(verbs: Sequence[Verb]) -> list[tuple[str, str]]:
    """(words so far, the verb that follows them)."""
    steps = [verb.path.rpartition(" ") for verb in verbs if verb.path]
    return [(before, name) for before, _, name in steps]


def _finding(verbs: Sequence[Verb]) -> list[str]:
    """Lines that fill ``found``."""
    lines = ["  found=()", '  case "$current" in', "    -*) case $verb in"]
    lines += [f"      {quoted(verb.path)}) found=({_list(verb.flags)}) ;;" for verb in verbs]
    lines += ["    esac ;;", '    *) case "$verb:$near" in']
    for verb in verbs:
        lines += [f"      {quoted(f'{verb.path}:{name}')}) found=({_list(of)}) ;;" for name, of in verb.choices.items()]
        if verb.words:
            lines.append(f'      {quoted(f"{verb.path}:")}) [ -z "$flag$given" ] && found=({_list(verb.words)}) ;;')
    lines += ["    esac", '    case "$verb:$flag" in']
    for verb in verbs:
        several = [name for name in verb.choices if name in verb.several]
        lines += [f"      {quoted(f'{verb.path}:{name}')}) found=({_list(verb.choices[name])}) ;;" for name in several]
    return [*lines, "    esac ;;", "  esac"]


def _list(words: Any) -> str:
    return " ".join(map(quoted, words))


def fish(verbs: Sequence[Verb]) -> list[str]:
    """The script for fish 3.0 and later."""
    paths = " ".join(quoted_for_fish(verb.path) for verb in verbs if verb.path)
    lines = [
        "function __su3d_bench_verb",
        "    set -l verb ''",
        "    for word in (commandline -opc)[2..-1]",
        f'        contains -- (string trim -- "$verb $word") {paths}; and set verb (string trim -- "$verb $word")',
        "    end",
        '    test "$verb" = "$argv[1]"',
        "end",
    ]
    for verb in verbs:
        here = f"complete -c su3d-bench -n {quoted_for_fish(f'__su3d_bench_verb {quoted_for_fish(verb.path)}')}"
        if verb.words:
            no_files = " -f" if any(path == verb.path for path, _ in _steps(verbs)) else ""
            lines.append(f"{here}{no_files} -a {_fish_list(verb.words)}")
        for name, text in verb.flags.items():
            kind = f"-l {quoted_for_fish(name[2:])}" if name.startswith("--") else f"-s {quoted_for_fish(name[1:])}"
            values = f" -x -a {_fish_list(verb.choices[name])}" if name in verb.choices else ""
            lines.append(f"{here} {kind}{values} -d {quoted_for_fish(' '.join(text.split()))}")
    return lines


def _fish_list(words: Sequence[str]) -> str:
    return quoted_for_fish(" ".join(map(quoted_for_fish, words)))
