"""Where the examples are."""

from pathlib import Path

from servobench.drivers.compiled import ROOT


def examples_folder() -> Path:
    """The examples: within an installed package, or at the top of a checkout."""
    installed = ROOT / "hil" / "examples"
    return installed if installed.is_dir() else ROOT / "examples"
