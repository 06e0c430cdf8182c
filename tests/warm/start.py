"""Starts the server, and says what to call in the place of ``hil`` and of ``sys.executable``."""

import atexit
import inspect
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from functools import cache
from pathlib import Path

from tests.warm import front, server

REAL_HIL = str(Path(sysconfig.get_path("scripts"), "hil"))
_ROOT = Path(__file__).parents[2]
_READY_S = 60.0


@cache
def folder() -> Path:
    """Holds ``hil``, to be called as it is; made once for each test process."""
    place = Path(tempfile.mkdtemp(prefix="warm-"))  # a socket's path has to be short
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    for name, real in (("hil", REAL_HIL), (server.PYTHON, sys.executable)):
        text = f"#!{sys.executable} -IS\n{inspect.getsource(front)}\n\nmain({real!r})\n"
        (place / name).write_text(text, encoding="utf-8")
        (place / name).chmod(0o755)
    _start_server(place)
    return place


def hil() -> list[str]:
    """The command ``hil``, for :mod:`subprocess`."""
    return [str(folder() / "hil")]


def python() -> str:
    """What to call in the place of this interpreter, as ``sys.executable``."""
    return str(folder() / server.PYTHON)


def _start_server(place: Path) -> None:
    """It ends when this process does: its input ends then."""
    started = subprocess.Popen(
        [sys.executable, "-P", "-m", server.__name__, str(place)],
        env={**os.environ, "CI": "true", "PYTHONPATH": str(_ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    assert started.stdin is not None
    assert started.stdout is not None
    assert started.stdout.readline() == b"ready\n"
    atexit.register(started.wait, _READY_S)
    atexit.register(started.stdin.close)
