"""``su3d-bench dev``: the installation, shell completion, and registries of results."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from su3d_bench.cli import doctor
from su3d_bench.cli.new import REGISTRY, add_new
from su3d_bench.cli.options import Verbs, add_group, add_verb, output_path, searched_folder
from su3d_bench.cli.output import answer, answer_either, answer_json, remark, show
from su3d_bench.core.errors import EXIT_CHECK_FAILED, EXIT_DONE, ConfigError, counted, printable

SHELLS = ("bash", "zsh", "fish")
MAX_REFUSED = 20  # lines


def add_parser(verbs: Verbs) -> None:
    """Check the installation, set up shell completion, keep registries of results.

    su3d-bench dev doctor
    su3d-bench dev completion fish | source
    """
    actions = add_group(verbs, "dev", add_parser)
    # computes nothing, and shows the thread settings
    add_verb(actions, "doctor", doctor.call, data=True).set_defaults(uses_all_cores=True)
    parser = add_verb(actions, "completion", call_completion)
    parser.option("shell", "shell to complete for", choices=SHELLS)
    _add_registry(actions)


def call_completion(arguments: argparse.Namespace) -> None:
    """Print a shell completion script.

    eval "$(su3d-bench dev completion bash)"
    su3d-bench dev completion fish | source
    """
    from argcomplete.shell_integration import shellcode

    script = shellcode(["su3d-bench"], shell=arguments.shell)
    answer_either(arguments, {"shell": arguments.shell, "script": script}, *script.splitlines())


def _add_registry(verbs: Verbs) -> None:
    """Maintain a registry of results: add re-scored bundles and build a site of rankings.

    su3d-bench dev registry add reproduced/rooms/bundle.zip --registry my-registry
    su3d-bench dev registry build my-registry --out site
    """
    actions = add_group(verbs, "registry", _add_registry)
    parser = add_verb(actions, "add", call_registry_add, data=True)
    parser.option("bundles BUNDLE...", "archives written by report bundle or reproduce")
    parser.option("--registry DIR", "registry folder (default: the current folder)", type=output_path, default=Path())
    parser.option("--bundle-name NAME", "name of the bundle in the registry (default: from its file or recipe)")
    parser = add_verb(actions, "build", call_registry_build)
    parser.option("folder DIR", "registry, or any folder of bundles", type=searched_folder)
    parser.option("--out DIR", "folder of the site (default: site)", type=output_path, default=Path("site"))
    parser.option("--title TEXT", "title of the page (default: Registry of results)")
    parser.option("--bundle-url URL", "base URL for links to bundles (default: no links)")
    add_new(actions, REGISTRY)


def call_registry_add(arguments: argparse.Namespace) -> int:
    """Re-score bundles and add them to a registry; exit code 1 if one is rejected.

    su3d-bench dev registry add bundle.zip --registry my-registry --bundle-name opensu3d-rooms
    su3d-bench dev registry add bundles/mine.zip
    """
    from dataclasses import asdict

    from su3d_bench.reproducing.registry import add_bundle, lines_of

    if arguments.bundle_name is not None and len(arguments.bundles) > 1:
        raise ConfigError("--bundle-name: applies to one bundle; add the bundles one at a time")
    found = []
    for bundle in arguments.bundles:
        found.append(add_bundle(bundle, arguments.registry, arguments.bundle_name))
        if not arguments.json:
            answer(*lines_of(found[-1]))
            show()
    answer_json(arguments, {"bundles": [{**asdict(one), "is_added": not one.reasons} for one in found]})
    return EXIT_CHECK_FAILED if any(one.reasons for one in found) else EXIT_DONE


def call_registry_build(arguments: argparse.Namespace) -> int:
    """Build a static site of a registry; exit code 1 if an entry cannot be ranked.

    su3d-bench dev registry build my-registry --out site
    su3d-bench dev registry build . --out site --title "Maps of rooms" --bundle-url https://example.org/bundles
    """
    from su3d_bench.reproducing.registry import read_registry
    from su3d_bench.reproducing.registry_site import TITLE, write_site

    registry = read_registry(arguments.folder, with_pictures=True)
    title = TITLE if arguments.title is None else printable(arguments.title, 120)
    pages = write_site(registry, arguments.out, title, arguments.bundle_url)
    refused = [f"excluded: {one.run}, {one.what}: {one.reason}" for one in registry.refused]
    remark(*refused[:MAX_REFUSED])
    if len(refused) > MAX_REFUSED:
        remark(f"excluded: {len(refused) - MAX_REFUSED} more")
    counts = f"{counted(len(registry.rows), 'row')} of {counted(registry.n_bundles, 'bundle')} in "
    value: dict[str, Any] = {
        "index": str(pages[0]),
        "n_pages": len(pages) - 1,
        "n_bundles": registry.n_bundles,
        "n_rows": len(registry.rows),
        "left_out": [vars(one) for one in registry.refused],
    }
    answer_either(arguments, value, f"{pages[0]}: {counts}{counted(len(registry.boards), 'ranking')}")
    return EXIT_CHECK_FAILED if refused else EXIT_DONE
