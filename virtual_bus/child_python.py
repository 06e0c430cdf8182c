"""Programs of ours as processes of their own: what lies in the user's folder is not imported by them."""

import os
import sys
import sysconfig
from pathlib import Path

ROOT = Path(str(sys.modules["servobench"].__file__)).resolve().parents[1]
"""The folder that holds the package."""


def python_command(module: str, *arguments: str) -> list[str]:
    """``module`` as a program of this interpreter; without ``-P`` the current folder would be on its path."""
    return [sys.executable, "-P", "-m", module, *arguments]


def python_environment(**added: str) -> dict[str, str]:
    """This process's environment for :func:`python_command`, and ``added``.

    The child finds the package where this process has found them: in a checkout that is not installed too. An
    empty entry of PYTHONPATH means the current folder, and so does a colon too many.
    """
    here = os.getcwd()
    entries = [os.path.abspath(entry) for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    kept = [entry for entry in entries if entry not in (here, str(ROOT))]
    if str(ROOT) not in (sysconfig.get_path("purelib"), sysconfig.get_path("platlib")):
        kept.insert(0, str(ROOT))
    return {**os.environ, "PYTHONPATH": os.pathsep.join(kept), **added}
