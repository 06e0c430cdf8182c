"""Finds the examples."""

from pathlib import Path

from servobench.drivers.compiled import ROOT


def examples_folder() -> Path:
    """Return the examples: within an installed package, or at the top of a checkout."""
    installed = ROOT / "hil" / "examples"
    return installed if installed.is_dir() else ROOT / "examples"
