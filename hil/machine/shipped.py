"""Finds what is no code and comes with the package: the examples and the pages of the documentation."""

from pathlib import Path

from servobench.drivers.compiled import ROOT


def examples_folder() -> Path:
    """Return the examples: within an installed package, or at the top of a checkout."""
    return _shipped("examples")


def docs_folder() -> Path:
    """Return the pages of the documentation, in Markdown."""
    return _shipped("docs")


def _shipped(name: str) -> Path:
    installed = ROOT / "hil" / name
    return installed if installed.is_dir() else ROOT / name
