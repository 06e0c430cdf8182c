"""Packages that not every user needs, and which extra of servobench brings each.

Finds what is no code and comes with the package: the examples and the pages of the documentation.
"""

import traceback
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from servobench.drivers.compiled import ROOT
from servobench.drivers.errors import BenchError
from servobench.hil.machine.held_process import OWN_FILES

EXTRAS: Final = {
    "rerun": "view",
    "rerun_cli": "view",
    "scipy": "design",
    "cvxpy": "design",
    "clarabel": "design",
    "flint": "design",
    "matplotlib": "report",
    "distributed": "campaign",
    "asammdf": "mf4",
}
"""Package as it is imported -> extra of pyproject.toml; ``campaign`` brings scipy and matplotlib too."""


class MissingExtra(BenchError):
    """A package that this needs comes with an extra of servobench, and is not installed."""

    exit_status = 2

    def __init__(self, package: str, command: str = "this", extra: str = "") -> None:
        """``extra``: one that brings the package, too, and serves ``command`` better."""
        name = extra or EXTRAS[package]
        super().__init__(
            f"{command} needs the extra {name} ({package} is not installed): pip install 'servobench[{name}]'"
        )


def is_installed(package: str) -> bool:
    """Return whether one of :data:`EXTRAS` can be imported; nothing is loaded."""
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:
        return False


def missing_extra(error: BaseException, command: str = "this") -> MissingExtra | None:
    """``error`` as a package of an extra that is missing; None: it is none, or code of the user's asked."""
    if not isinstance(error, ModuleNotFoundError):
        return None
    package = (error.name or "").partition(".")[0]
    frames = traceback.extract_tb(error.__traceback__)
    if package not in EXTRAS or any(frame.filename in OWN_FILES for frame in frames):
        return None
    return MissingExtra(package, command, "campaign" if "campaign" in command else "")


def examples_folder() -> Path:
    """Return the examples: within an installed package, or at the top of a checkout."""
    return _shipped("examples")


def docs_folder() -> Path:
    """Return the pages of the documentation, in Markdown."""
    return _shipped("docs")


def _shipped(name: str) -> Path:
    installed = ROOT / "hil" / name
    return installed if installed.is_dir() else ROOT / name
