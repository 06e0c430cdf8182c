"""Runs tests in a copy of the tree, a process each, from one that has imported what others have made.

Started in the copy as ``python tests/code_mutants/server.py``. A line of JSON in is a run: ``arguments`` of
pytest, ``timeout_s``, ``calls``, where to write the first lines of the functions called in each file, or "",
and ``pure``, whether compiled modules are left unused. A line out is its exit status: that of pytest, or
"timeout". Nothing of the product is imported before a process is forked off: it is the copy's of that time.
"""

import importlib
import json
import os
import signal
import sys
import threading
from contextlib import suppress
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final

PRELOADED: Final = (
    "can", "canopen", "hypothesis", "numpy", "pydantic", "pytest", "scipy.linalg", "scipy.signal",
    "scipy.stats", "scipy.optimize", "typer", "rich.console",
)  # fmt: skip
ROOMS: Final = ("design", "drivers", "hil", "virtual_bus")
QUIET: Final = ("-p", "no:cacheprovider", "-W", "ignore:Module already imported", "--no-header", "--tb=line")


def main() -> None:
    """Serve until the end of the input."""
    sys.path.insert(0, str(Path.cwd()))
    sys.dont_write_bytecode = "write" not in sys.argv[1:]
    for name in PRELOADED:
        importlib.import_module(name)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD})
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    for line in sys.stdin:
        run = json.loads(line)
        print(json.dumps(_run(**run)), flush=True)


def _run(arguments: list[str], timeout_s: float, calls: str, pure: bool) -> int | str:
    child = os.fork()
    if child == 0:
        os.environ["SERVOBENCH_PURE"] = "1" if pure else ""
        _be_pytest(arguments, calls)
    try:
        while True:
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended:
                return os.waitstatus_to_exitcode(status)
            if signal.sigtimedwait({signal.SIGCHLD}, timeout_s) is None:
                return "timeout"
    finally:
        _end_group(child)


def _end_group(leader: int) -> None:
    """The run, if it still goes on, and what its tests have started and left."""
    with suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGKILL)
    with suppress(ChildProcessError):
        os.waitpid(leader, 0)


def _be_pytest(arguments: list[str], calls: str) -> None:
    os.setsid()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGCHLD})
    null = os.open(os.devnull, os.O_RDWR)
    said = os.open("said.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(null, 0)
    os.dup2(said, 1)
    os.dup2(said, 2)
    import pytest

    called: dict[str, list[int]] = {}
    if calls:
        _note_calls(called)
    status = int(pytest.main([*QUIET, *arguments]))
    if calls:
        sys.settrace(None)
        Path(calls).write_text(json.dumps(called), encoding="utf-8")
    sys.stdout.flush()
    os._exit(status)


def _note_calls(called: dict[str, list[int]]) -> None:
    here = f"{Path.cwd()}/"
    rooms = tuple(here + room for room in ROOMS)

    seen: dict[int, CodeType] = {}  # which also keeps an id from being given anew

    def trace(frame: FrameType, _event: str, _value: Any) -> None:
        code = frame.f_code
        if id(code) in seen:
            return
        seen[id(code)] = code
        if code.co_filename.startswith(rooms):
            first = 0 if code.co_name == "<module>" else code.co_firstlineno
            called.setdefault(code.co_filename.removeprefix(here), []).append(first)

    threading.settrace(trace)
    sys.settrace(trace)


if __name__ == "__main__":
    main()
