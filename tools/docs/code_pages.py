"""Pages of the documentation site generated from the code: protocols, methods, public names, records of a run."""

from __future__ import annotations

import dataclasses
import inspect
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from command_pages import command_pages
from site_text import heading, plain, prose, table

import su3d_bench
from su3d_bench.cli.main import main
from su3d_bench.core import registry
from su3d_bench.core.config import flatten, toml_value
from su3d_bench.metrics.protocols.kinds import RULES_OF_KIND
from su3d_bench.metrics.protocols.loading import (
    HEADING,
    Original,
    ResolvedOriginal,
    load_protocol,
    not_comparable_with,
    original_of,
    protocol_names,
    remarks_of,
    rules_files,
)
from su3d_bench.metrics.protocols.model import ProtocolRules
from su3d_bench.reports.tables.paper import Figure, figures_of
from su3d_bench.store import records

PROTOCOLS = "reference/protocols"
METHODS = "reference/methods"
API = "reference/api.md"
RECORDS = "reference/records.md"
REPORTED = "Values as reported in papers, each in its own set-up; they need not be comparable."


def made_pages() -> dict[str, str]:
    """All generated pages by their path in the site."""
    protocols = [load_protocol(name) for name in protocol_names()]
    methods = [summary_of(name) for name in registry.BUILT_IN["method"]]
    return {
        f"{PROTOCOLS}/index.md": protocols_page(protocols),
        **{
            f"{PROTOCOLS}/{rules.name}.md": protocol_page(rules, rules_files(rules.name), original_of(rules.name))
            for rules in protocols
        },
        f"{METHODS}/index.md": methods_page(methods),
        **{f"{METHODS}/{method['name']}.md": method_page(method) for method in methods},
        API: api_page(),
        RECORDS: records_page(),
        **command_pages(),
    }


def _code(text: object) -> str:
    return f"<code>{plain(text)}</code>"


def _codes(names: Iterable[object]) -> str:
    return ", ".join(map(_code, names))


def _linked(names: Iterable[str], folder: str = ".") -> str:
    return ", ".join(f'<a href="{folder}/{plain(name)}.html">{_code(name)}</a>' for name in names) or "none"


def _page(title: str, *parts: str) -> str:
    return "\n\n".join([f"# {heading(title)}", *filter(None, parts)]) + "\n"


def protocols_page(protocols: Sequence[ProtocolRules]) -> str:
    head = ("protocol", "what it measures", "kind", "headline", "datasets", "original")
    rows = [
        (
            _linked([rules.name]),
            plain(rules.summary),
            plain(rules.kind),
            plain(", ".join(rules.headline)),
            plain(", ".join(rules.datasets) or "any"),
            _source(stated.original) if (stated := original_of(rules.name)) else "",
        )
        for rules in protocols
    ]
    return _page(
        "The protocols",
        "<p>A protocol is the set of rules by which a map is scored. Each has a page, generated from the file that the "
        "program reads: every rule with its source, the evaluation it reproduces, how both were compared with each "
        "other, and with what its results may not be compared.</p>",
        table(head, rows, is_stacked=True),
    )


def _source(original: Original) -> str:
    """The repository and commit as a link, or a remark that there is none."""
    if original.place is None:
        return "none"
    return f'<a href="{plain(original.place)}">{plain(original.code)} at {plain(str(original.commit)[:7])}</a>'


def _original_of(stated: ResolvedOriginal | None) -> list[str]:
    """The section on the original evaluation."""
    if stated is None:
        return []
    rows = [
        (plain(name), _source(stated.original) if name == "original" and stated.original.place else prose(text))
        for name, text in stated.facts.items()
    ]
    return ["## Original", table((), rows, is_stacked=True)]


def protocol_page(rules: ProtocolRules, files: Sequence[Path], stated: ResolvedOriginal | None = None) -> str:
    """The output of ``su3d-bench protocols show NAME``, as a page."""
    remarks = remarks_of(files)
    sources = " ".join(remarks.pop(HEADING, [])).replace(" extends ", "\nextends ").split("\n")
    figures = figures_of(protocol=rules.name)
    glance = [
        ("kind", f"{_code(rules.kind)}: {prose(_first_line(RULES_OF_KIND[rules.kind]))}"),
        ("headline", plain(", ".join(rules.headline))),
        ("datasets", plain(", ".join(rules.datasets) or "any") + ("" if rules.by_default else "; if requested")),
        ("version", plain(rules.version)),
        ("not comparable with", _linked(not_comparable_with(rules))),
        ("digest", _code(rules.digest)),
    ]
    classes = remarks.pop("classes", [])
    rows, absent = _rules_of(rules, remarks)
    return _page(
        rules.name,
        f"<p>{plain(rules.summary)}</p>",
        *(f"<p>{prose(source)}</p>" for source in sources),
        table((), glance, is_stacked=True),
        *_original_of(stated),
        "## Every rule",
        table(("rule", "value", "source (or ours)"), rows, is_stacked=True),
        f"<p>Not set: {_codes(absent)}.</p>" if absent else "",
        *(f"<p>{prose(remark)}</p>" for remark in _left(remarks)),
        *_classes_of(rules, classes),
        *_reported(figures, "method"),
        "## On the command line",
        f"<pre><code>su3d-bench protocols show {plain(rules.name)}</code></pre>",
    )


def _first_line(thing: object) -> str:
    return (inspect.getdoc(thing) or "").partition("\n")[0]


def _rules_of(rules: ProtocolRules, remarks: dict[str, list[str]]) -> tuple[list[tuple[str, str, str]], list[str]]:
    """One row per rule that is set or documented, with remarks removed; and the names of the others."""
    rows, absent = [], []
    for path, value in flatten(rules.model_dump(mode="json", exclude={"classes", "not_comparable_with", "summary"})):
        key = ".".join(path)
        remark = " ".join(remarks.pop(key, []))
        if value in (None, []) and not remark:
            absent.append(key)
        else:
            rows.append((_code(key), "none" if value is None else _code(toml_value(value)), prose(remark)))
    return rows, absent


def _left(remarks: Mapping[str, Sequence[str]]) -> list[str]:
    return [" ".join(lines) for lines in remarks.values() if lines]


def _classes_of(rules: ProtocolRules, remarks: Sequence[str]) -> list[str]:
    if not rules.classes:
        return []
    has_groups = any(entry.group for entry in rules.classes)
    head = ("id", "name", *(("group",) if has_groups else ()), "")
    rows = [
        (
            plain(entry.id),
            plain(entry.name),
            *((plain(entry.group or ""),) if has_groups else ()),
            "ignored" if rules.is_ignored(entry.name) else "",
        )
        for entry in rules.classes
    ]
    counts = f"{len(rules.scored)} of {len(rules.classes)} classes are scored"
    folded = f"<details>\n<summary>{counts}</summary>\n{table(head, rows)}\n</details>"
    return ["## Classes", f"<p>{prose(' '.join(remarks))}</p>" if remarks else "", folded]


def _reported(figures: Sequence[Figure], who: str) -> list[str]:
    """The section of published values; ``who`` is the heading of the first column: method or protocol."""
    if not figures:
        return []
    rows = [
        (
            _code(getattr(figure, who)) if getattr(figure, who) else "",
            plain(", ".join(f"{name} {value}" for name, value in figure.values.items())),
            plain(f"{figure.source}{f' [{figure.row}]' if figure.row else ''}"),
            plain("; ".join(filter(None, [figure.setup, figure.note, figure.system.words]))),
        )
        for figure in figures
    ]
    shown = table((who, "numbers", "source", "set-up"), rows, is_stacked=True)
    fold = f"<details>\n<summary>{len(rows)} rows</summary>\n{shown}\n</details>" if len(rows) > 12 else shown
    return ["## As reported", f"<p>{REPORTED}</p>", fold]


def summary_of(name: str) -> dict[str, Any]:
    """The output of ``su3d-bench methods show NAME --json``."""
    with redirect_stdout(io.StringIO()) as answer:
        main(["methods", "show", name, "--json"])
    info: dict[str, Any] = json.loads(answer.getvalue())
    return info


def methods_page(methods: Sequence[Mapping[str, Any]]) -> str:
    rows = [(_linked([row["name"]]), prose(row["summary"]), plain("; ".join(row["needs"]))) for row in methods]
    return _page(
        "The methods",
        "<p>A method turns the frames of a scene into a map of instances. Each has a page generated from its class: "
        "its source, how it was verified, every setting with its default, presets, and values reported in papers.</p>",
        table(("method", "what it does", "needs"), rows, is_stacked=True),
    )


def method_page(info: Mapping[str, Any]) -> str:
    """The output of ``su3d-bench methods show NAME``, as a page."""
    name = info["name"]
    origin = [(field, prose(info[field])) for field in ("paper", "source", "licence") if info[field]]
    origin += [("needs", plain("; ".join(info["needs"])))] if info["needs"] else []
    origin += [("verification", prose(info["status"]))] if info["status"] else []
    schema = registry.load("method", name).Config.model_json_schema()
    settings = [
        (_code(".".join(path)), _takes(schema, path), "not set" if value is None else _code(toml_value(value)))
        for path, value in flatten(info["settings"])
    ]
    presets = [
        (_code(f"{name}@{preset}"), _codes(f"{key} = {json.dumps(value)}" for key, value in own.items()))
        for preset, own in info["presets"].items()
    ]
    given = f"Set with <code>--set {plain(name)}.KEY=VALUE</code>, or in a file for <code>--config</code>."
    return _page(
        name,
        f"<p>{prose(info['summary'])}</p>",
        table((), origin, is_stacked=True) if origin else "",
        "## Settings",
        f"<p>{given if settings else 'None.'}</p>",
        table(("setting", "takes", "default"), settings, is_stacked=True) if settings else "",
        *(["## Presets", "<p>Each is a method with its own name.</p>"] if presets else []),
        table(("method", "settings"), presets, is_stacked=True) if presets else "",
        *_reported(figures_of(method=name), "protocol"),
        "## On the command line",
        f"<pre><code>su3d-bench methods show {plain(name)}</code></pre>",
    )


def _takes(schema: Mapping[str, Any], path: Sequence[str]) -> str:
    """The allowed values of a setting, from the JSON schema."""
    field: Mapping[str, Any] = schema
    for part in path:
        field = _resolved(schema, field).get("properties", {}).get(part, {})
    return " or ".join(dict.fromkeys(_describe(schema, one) for one in field.get("anyOf", [field])))


def _resolved(schema: Mapping[str, Any], field: Mapping[str, Any]) -> Mapping[str, Any]:
    reference = str(field.get("$ref", "")).rpartition("/")[2]
    found: Mapping[str, Any] = schema.get("$defs", {}).get(reference, field)
    return found


WORDS = {"integer": "whole number", "number": "number", "boolean": "true or false", "string": "text", "null": "nothing"}


def _describe(schema: Mapping[str, Any], field: Mapping[str, Any]) -> str:
    field = _resolved(schema, field)
    if "enum" in field:
        return ", ".join(_code(value) for value in field["enum"])
    if "const" in field:
        return _code(field["const"])
    kind = str(field.get("type", "value"))
    if kind == "array":
        items = field.get("items", {})
        return f"list of {_describe(schema, items)}" if items else "list"
    limits = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "below"}
    bounds = [f"{word} {plain(field[key])}" for key, word in limits.items() if key in field]
    return " ".join([WORDS.get(kind, plain(kind)), *bounds])


def api_page() -> str:
    """One section per public name, which mkdocstrings fills in from its docstring and signature."""
    public = [(name, getattr(su3d_bench, name)) for name in sorted(su3d_bench.__all__, key=str.lower)]
    sections = {
        "Functions": [name for name, thing in public if inspect.isroutine(thing)],
        "Types": [name for name, thing in public if not inspect.isroutine(thing)],
    }
    parts = [
        "\n\n".join([f"## {title}", *(f"::: su3d_bench.{name}" for name in names)])
        for title, names in sections.items()
        if names
    ]
    return _page(
        "Every public name",
        "```python\nimport su3d_bench as su3d\n```",
        "<p>The names of <code>su3d_bench</code> are imported at first use; all other names may change.</p>",
        *parts,
    )


def records_page() -> str:
    """The fields of every record in the files of a run folder, from its class."""
    parts = []
    for name, record in vars(records).items():
        if isinstance(record, type) and dataclasses.is_dataclass(record) and record.__module__ == records.__name__:
            rows = [(_code(field.name), _code(field.type), _default(field)) for field in dataclasses.fields(record)]
            described = "".join(f"<p>{prose(part)}</p>" for part in (inspect.getdoc(record) or "").split("\n\n"))
            parts += [f"## {heading(name)}", described, table(("field", "type", "default"), rows, is_stacked=True)]
    return _page("Records of a run", f"<p>{prose(inspect.getdoc(records))}</p>", *parts)


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        return _code(repr(field.default))
    return "required" if field.default_factory is dataclasses.MISSING else "empty"
