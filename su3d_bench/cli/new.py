"""The commands ``new``: write a template of a method, dataset, protocol or registry."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from su3d_bench.cli.options import Verbs, add_verb, output_path
from su3d_bench.cli.output import answer_either
from su3d_bench.core.errors import ConfigError

SUFFIX = {"method": ".py", "dataset": ".py", "protocol": ".toml"}
REGISTRY = "registry"
TEMPLATES = Path(__file__).parent / "templates"
TEMPLATE_OF = {"method": "my_method.py.txt", "dataset": "my_dataset.py.txt", "protocol": "my_protocol.toml"}
# Target of each template file; git does not store empty folders, so bundles gets a file.
REGISTRY_FILES = {
    "README.md": "README.md",
    "requirements.txt": "requirements.txt",
    "gitignore.txt": ".gitignore",
    "workflow.yml": ".github/workflows/registry.yml",
}
KEPT = "bundles/.gitkeep"
# Clients and examples of programs that get a scene frame by frame.
PROGRAM_FILES = ("su3d_client.py.txt", "su3d_client.hpp", "voxels.py.txt", "voxels.cpp")
# Next commands; {at} is the file on the command line.
NEXT = {
    "method": ("methods check {at}", "run --scenes homes/tuning0 --methods {at}"),
    "dataset": ("datasets check '{at}/*'", "run --scenes '{at}/*' --profile oracle"),
    "protocol": ("protocols show {at}", "run --scenes homes/tuning0 --protocols {at}"),
    REGISTRY: ("dev registry add BUNDLE --registry {at}", "dev registry build {at} --out site"),
}


def add_new(verbs: Verbs, what: str) -> None:
    """Add the command ``new`` of methods, datasets, protocols and registries."""
    group = {REGISTRY: "dev registry"}.get(what, f"{what}s")
    place = "my-registry" if what == REGISTRY else f"my_{what}{SUFFIX[what]}"
    about = f"""Create a {what} from a working template.

    su3d-bench {group} new {place}
    su3d-bench {group} new {place} --json
    """
    parser = add_verb(verbs, "new", call, about)
    parser.set_defaults(what=what)
    if what == REGISTRY:
        parser.option("file DIR", "folder to create", type=output_path)
    else:
        programs = "; a folder gets clients and examples in Python and C++ instead" if what == "method" else ""
        parser.option("file FILE", f"file to create; its name becomes that of the {what}{programs}", type=output_path)


def call(arguments: argparse.Namespace) -> None:
    from su3d_bench.cli.output import written
    from su3d_bench.core.system.files import file_text

    what, file = arguments.what, arguments.file
    if what == REGISTRY:
        _new_registry(file, arguments)
        return
    if what == "method" and not file.suffix:
        _new_program(file, arguments)
        return
    if file.suffix != SUFFIX[what]:
        raise ConfigError(f"{what}s new: {file} must end in {SUFFIX[what]}, such as my_{what}{SUFFIX[what]}")
    words = re.findall(r"[A-Za-z0-9]+", file.stem)
    if not words or words[0][0].isdigit():
        raise ConfigError(f"{what}s new: '{file.stem}' is not a valid name; use one such as my_{what}{SUFFIX[what]}")
    if file.exists():
        raise ConfigError(f"{what}s new: {file} exists; choose another name")
    name, class_name = "-".join(words).lower(), "".join(word[0].upper() + word[1:] for word in words)
    template = file_text(TEMPLATES / TEMPLATE_OF[what])
    text = template.replace(f"My{what.capitalize()}", class_name).replace(f"my-{what}", name)
    written(file, text)
    at = str(file) if what == "protocol" else f"{file}:{class_name}"
    commands = [f"su3d-bench {command.format(at=at)}" for command in NEXT[what]]
    lines = (f"{file}; then:", *(f"  {command}" for command in commands))
    answer_either(arguments, {"file": str(file), "next": commands}, *lines)


def _new_program(folder: Path, arguments: argparse.Namespace) -> None:
    """Write programs that get a scene frame by frame, in Python and C++, and the clients that they use."""
    from su3d_bench.cli.output import written
    from su3d_bench.core.system.files import file_text

    if folder.exists():
        raise ConfigError(f"methods new: {folder} exists; choose another folder")
    for name in PROGRAM_FILES:
        written(folder / name.removesuffix(".txt"), file_text(TEMPLATES / "program" / name))
    words = f"""command.frame_by_frame=true 'command.command=["python", "{folder}/voxels.py"]'"""
    command = f"su3d-bench run --scenes homes/tuning0 --methods command --set {words}"
    lines = (f"{folder}: clients and examples in Python and C++; then:", f"  {command}")
    answer_either(arguments, {"file": str(folder), "next": [command]}, *lines)


def _new_registry(folder: Path, arguments: argparse.Namespace) -> None:
    """Create a repository whose CI re-scores the bundles of pull requests and publishes the site."""
    import os
    import shlex

    from su3d_bench.cli.output import written
    from su3d_bench.core.system.files import file_text
    from su3d_bench.core.version import __version__

    name = Path(os.path.abspath(folder)).name
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
        raise ConfigError(f"dev registry new: '{name}' is not a valid repository name; use one such as my-registry")
    taken = next(
        (path for path in map(folder.joinpath, (*REGISTRY_FILES.values(), KEPT)) if os.path.lexists(path)), None
    )
    if taken is not None or (os.path.lexists(folder) and not folder.is_dir()):
        raise ConfigError(f"dev registry new: {taken or folder} exists; choose another folder")
    for source, place in REGISTRY_FILES.items():
        text = file_text(TEMPLATES / "registry" / source)
        written(folder / place, text.replace("my-registry", name).replace("VERSION", __version__))
    written(folder / KEPT, "")
    commands = [f"su3d-bench {command.format(at=shlex.quote(str(folder)))}" for command in NEXT[REGISTRY]]
    lines = (f"{folder}: a repository for git; then:", *(f"  {command}" for command in commands))
    answer_either(arguments, {"file": str(folder), "next": commands}, *lines)
