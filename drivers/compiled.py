"""Decides which compiled modules may be used: those built from the present sources, for this Python.

``setup.py`` compiles the hot modules in groups, each one library, and leaves a manifest of what they were
made from, in a checkout as in a wheel. A compiled module shadows its source: an old one would run what nobody
reads any more, and one compiled against another group's old class layout would read attributes at wrong
offsets. So the sources are compared with the manifest before the first hot module is imported. An edited
module takes its group back to its sources, interpreted, and with it every group compiled against that one.
"""

import json
import os
import sys
from collections.abc import Sequence
from functools import cache
from hashlib import blake2b
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "servobench"
ROOMS = ("design", "drivers", "virtual_bus", "hil")
MANIFEST = "drivers/compiled.json"
"""Below the root; written when a build is complete: ``suffix`` of its files, and for each group ``sources``
(file -> digest) and the groups ``against`` which it is compiled; or ``lack``, why nothing is compiled."""
LIBRARIES = "*/compiled_*__mypyc*"
SUFFIX = EXTENSION_SUFFIXES[0]
_SHOWN_MAX = 3
"""Of the files that were edited."""
PURE = "SERVOBENCH_PURE"
"""Environment variable: run everything from its sources."""


class Build(NamedTuple):
    """The parts of a build that are in use."""

    compiled: tuple[str, ...] = ()
    """Groups that run compiled."""
    held_back: tuple[str, ...] = ()
    """Groups that are compiled but run from their sources anyway."""
    why: str = ""
    """Why something is interpreted; empty if nothing is."""
    sources: frozenset[str] = frozenset()
    """Files whose compiled form is used."""
    unusable: bool = False
    """Compiled modules exist that must not be used."""


def digest_of(source: Path) -> str:
    """Return a digest that identifies this version of a source; empty if the file does not exist."""
    return blake2b(source.read_bytes(), digest_size=16).hexdigest() if source.exists() else ""


def look(root: Path = ROOT) -> Build:
    """Compare the build below ``root`` with the sources there."""
    if os.environ.get(PURE):
        return Build(why=f"{PURE} is set", unusable=True)
    try:
        manifest = json.loads((root / MANIFEST).read_text())
    except FileNotFoundError:
        if any(root.glob(LIBRARIES)):
            return Build(why="a build was not completed", unusable=True)
        return Build(why="nothing has been compiled")
    if lack := manifest.get("lack"):
        return Build(why=lack)
    if manifest.get("suffix") != SUFFIX:
        made_for = manifest.get("suffix", "another version of servobench")
        return Build(why=f"compiled for {made_for}, not for {SUFFIX}", unusable=True)
    return _compare(root, manifest["groups"])


def _compare(root: Path, groups: dict[str, dict[str, Any]]) -> Build:
    edited = {
        name: [file for file, digest in group["sources"].items() if digest_of(root / file) != digest]
        for name, group in groups.items()
    }
    stale = {name for name, files in edited.items() if files}
    while more := {name for name, group in groups.items() if stale.intersection(group["against"])} - stale:
        stale |= more
    files = [file for each in edited.values() for file in each]
    fresh = tuple(name for name in groups if name not in stale)
    return Build(
        compiled=fresh,
        held_back=tuple(name for name in groups if name in stale),
        why=f"edited since it was compiled: {_some(files)}" if files else "",
        sources=frozenset(file for name in fresh for file in groups[name]["sources"]),
        unusable=bool(stale),
    )


def _some(files: list[str]) -> str:
    """The first of them: after a change of branch all would fill a screen before every command."""
    more = len(files) - _SHOWN_MAX
    return ", ".join(files[:_SHOWN_MAX]) + (f" and {more} more" if more > 0 else "")


class SourcesOf:
    """A finder that loads our modules from source unless their compiled form is fresh."""

    def __init__(self, build: Build) -> None:
        files = (file.removesuffix(".py").replace("/", ".") for file in build.sources)
        self._compiled = frozenset(f"{PACKAGE}.{file}" for file in files)

    def find_spec(self, name: str, path: Sequence[str] | None, _target: Any = None) -> ModuleSpec | None:
        """Find a module's spec, as importlib asks; None leaves the module to the next finder."""
        if not name.startswith(f"{PACKAGE}.") or path is None or name in self._compiled:
            return None
        source = Path(path[0], f"{name.rpartition('.')[2]}.py")
        return spec_from_file_location(name, source) if source.exists() else None


@cache
def use_fresh() -> Build:
    """Keep this process from importing any compiled module that is out of date.

    Every package with compiled modules calls it, before the first of them is imported.
    """
    build = look()
    if build.unusable:
        sys.meta_path.insert(0, SourcesOf(build))
    return build


def notice(build: Build) -> str | None:
    """Return a line for the user if compiled modules exist but are not used, unless the user asked for
    that."""
    if not build.unusable or os.environ.get(PURE):
        return None
    return f"{', '.join(build.held_back) or 'all modules'} interpreted, {build.why}; {remedy()}"


def remedy(root: Path = ROOT) -> str:
    """Return the command that compiles everything."""
    if (root / "setup.py").exists():
        return "make compile"
    return "install servobench again where a C compiler and Python's headers are"
