"""mkdocs hooks for building the site: generated pages, their order, and links out of docs/."""

from __future__ import annotations

import tomllib
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from code_pages import PROTOCOLS, made_pages
from command_pages import command_names, place_of_command
from site_text import DOCS, ROOT, ROOT_PAGES, for_site

from su3d_bench.metrics.protocols.loading import protocol_names

_made: dict[str, str] = {}  # generated pages of this build, not in docs/


def on_config(config: Any) -> Any:
    """Generate the pages, and add each page to the navigation."""
    roots = {place: (ROOT / name).read_text() for name, place in ROOT_PAGES.items()}
    _made.update(made_pages() | roots)
    on_disk = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    config.nav = filled(config.nav, on_disk | set(_made))
    return config


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    for place, content in _made.items():
        files.append(File.generated(config, place, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **rest: Any) -> str:
    place = page.file.src_uri
    if place in _made and place not in ROOT_PAGES.values():
        return markdown
    path = next((name for name, root in ROOT_PAGES.items() if root == place), f"docs/{place}")
    names = {name: f"{PROTOCOLS}/{name}.md" for name in protocol_names()}
    names |= {f"su3d-bench {name}": place_of_command(name) for name in command_names()}
    repository = repository_of(ROOT / "pyproject.toml")
    return for_site(markdown, path, lambda name: (ROOT / name).exists(), repository, names)


def on_post_template(output: str, template_name: str, **rest: Any) -> str:
    """No 404 page: it needs a server, and its links are not paths on a disk."""
    return "" if template_name == "404.html" else output


def repository_of(project: Path) -> str | None:
    """The address on a code host that the project's metadata has; None if it has none."""
    urls = tomllib.loads(project.read_text())["project"].get("urls", {})
    found = next((str(url) for name, url in urls.items() if name.lower() in ("repository", "source")), None)
    return found and found.rstrip("/")


def filled(nav: list[Any], pages: set[str]) -> list[Any]:
    """``nav`` with patterns replaced by the matching pages, in order, and without empty entries.

    A page listed explicitly is not matched by patterns; of two patterns the first takes it.

    >>> filled([{"Start": "index.md"}, {"More": ["gone.md", "*.md"]}, {"Empty": "none/*.md"}], {"index.md", "a.md"})
    [{'Start': 'index.md'}, {'More': ['a.md']}]
    """
    left = pages - set(_leaves(nav))
    return _filled(nav, pages, left)


def _leaves(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    values = nav.values() if isinstance(nav, dict) else nav
    return [leaf for value in values for leaf in _leaves(value)]


def _filled(nav: list[Any], pages: set[str], left: set[str]) -> list[Any]:
    entries: list[Any] = []
    for entry in nav:
        title, value = next(iter(entry.items())) if isinstance(entry, dict) else (None, entry)
        if isinstance(value, list):
            inside = _filled(value, pages, left)
            entries += [{title: inside}] if inside else []
        elif value in pages:
            entries.append(entry)
        else:
            # a pattern covers one folder
            taken = sorted(one for one in left if fnmatch(one, value) and one.count("/") == value.count("/"))
            left -= set(taken)
            # an index first: it is the page of its section
            taken.sort(key=lambda one: not one.endswith("/index.md"))
            entries += taken if title is None or not taken else [{title: taken}]
    return entries
