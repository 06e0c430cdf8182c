"""``python -m tests.warm.server FOLDER``: forks programs that its fronts ask for.

One process, one thread: what is forked holds no lock of a thread that it has not. It has imported what the
programs import, and done nothing else. A second one, forked from it, does the same for the loggers. A front
(:mod:`tests.warm.front`) sends what a program is made from, then signals, a byte each; it gets one byte when
the program is taken, and at the end its status, negative the signal that ended it. A front that is gone takes
its program along, at once.
"""

import atexit
import fcntl
import gc
import io
import marshal
import os
import random
import runpy
import select
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn, TextIO

from tests.warm.front import LOGGER

PYTHON: Final = "forked-python"
"""The front that stands for the interpreter."""
ROLES: Final = {
    "bench": (
        "servobench.hil.campaign.worker",
        "servobench.hil.cli",
        "servobench.hil.commissioning.session",
        "servobench.hil.configuration.bench_file",
        "servobench.hil.configuration.config_files",
        "servobench.hil.execution.bench",
        "servobench.hil.execution.simulated_drives",
        "servobench.hil.inspecting.scanning",
        "servobench.hil.measuring.measure",
        "servobench.hil.recording.recorder",
        "servobench.hil.terminal.report",
        "rich.console",
        "rich.panel",
        "rich.table",
        "tomlkit",
        "typer.rich_utils",
        "servobench.virtual_bus.bus.hub_process",
    ),
    "logger": (
        "servobench.hil.recording.logger",
        "servobench.hil.recording.recovery",
        "servobench.hil.recording.page_keepers",
        "servobench.hil.recording.rerun_anew",
    ),
}
"""What is imported before the first program is forked."""
THREADS: Final = {
    "bench": frozenset[str](),
    # of pyarrow's allocator, which sees to forks itself, and of Rerun's connections to viewers, which only
    # a live view has: a run with one is refused
    "logger": frozenset({"jemalloc_bg_thd", "tokio-rt-worker"}),
}
"""Of a process that has imported that, and has its own name besides."""
_REFUSED: Final = {"--view"}
"""Words of a command whose processes need more than is forked."""
_FREE: Final = {
    "CI", "COLUMNS", "LINES", "OLDPWD", "OPENBLAS_NUM_THREADS", "PATH", "PWD", "PYTEST_CURRENT_TEST",
    "PYTHONPATH", "SHLVL", "TMPDIR", "UNVIEWED", "XDG_RUNTIME_DIR", "_", "_RJEM_MALLOC_CONF",
}  # fmt: skip
"""Variables that are looked at when they are needed, or set by every program of ours, or by an import of
python-can in a test's process; any other may decide what an import does."""
_ROOT: Final = os.fsencode(Path(__file__).parents[2])
_HIGH: Final = 512
"""Above the descriptors of any program, while these are put into their places."""
_DESCRIPTORS_MAX: Final = 253
"""SCM_MAX_FD of unix(7)."""


class Asked(NamedTuple):
    """A program, as its front has it."""

    module: str
    arguments: list[str]
    folder: bytes | str
    environment: dict[bytes, bytes]
    descriptors: list[int]
    ignored: list[int]
    """Signals."""

    def is_of(self, own: Mapping[bytes, bytes]) -> bool:
        """Whether a process with environment ``own`` has imported what this program would import."""
        different = {key for key, value in {*self.environment.items()} ^ {*own.items()} if value}
        searched = self.environment.get(b"PYTHONPATH", b"")
        if _REFUSED.intersection(self.arguments) or searched not in (b"", _ROOT):
            return False
        return not different - {key.encode() for key in _FREE}


class Running(NamedTuple):
    """A program that was forked."""

    front: socket.socket
    process_id: int


def serve(listener: socket.socket, role: str, ended: int) -> Asked:
    """Fork what is asked for, until ``ended`` can be read: then the process ends. Returns in each fork."""
    own = dict(os.environb)
    threads = {Path(f"/proc/self/task/{task}/comm").read_text().strip() for task in _tasks()}
    assert threads - {Path("/proc/self/comm").read_text().strip()} <= THREADS[role], threads
    assert role != "bench" or len(_tasks()) == 1
    running: dict[int, Running] = {}
    """By the descriptor that tells its end, and by that of its front."""
    while True:
        # the listener last: what it accepts may get the number of a descriptor that was closed just before
        ready, _, _ = select.select([ended, *running, listener.fileno()], [], [])
        if ended in ready:
            _end(running)
        for descriptor in ready:
            if descriptor == listener.fileno():
                front = listener.accept()[0]
                asked, received = _hear(front)
                if asked is None or not asked.is_of(own) or not _send(front, b"+"):
                    _close(front.detach(), *received)
                    continue
                child = os.fork()
                if not child:
                    for end in (front, *(program.front for program in running.values())):
                        end.detach()  # else it would close what has its number then
                    _take_place(asked, received)
                    return asked
                _close(*received)
                program = Running(front, child)
                running[os.pidfd_open(child)] = running[front.fileno()] = program
            elif descriptor in running:
                program = running[descriptor]
                if descriptor == program.front.fileno():
                    _forward(program, running)
                else:
                    _bury(program, descriptor, running)


def _end(running: Mapping[int, Running]) -> NoReturn:
    for program in running.values():
        os.kill(program.process_id, signal.SIGKILL)
    with suppress(ChildProcessError):
        while True:
            os.wait()
    os._exit(0)


def _forward(program: Running, running: dict[int, Running]) -> None:
    try:
        numbers = program.front.recv(16)
    except ConnectionResetError:  # killed before it had read that its program is taken
        numbers = b""
    for number in numbers or [signal.SIGKILL]:
        os.kill(program.process_id, number)
    if not numbers:
        del running[program.front.fileno()]


def _bury(program: Running, ended: int, running: dict[int, Running]) -> None:
    status = os.waitstatus_to_exitcode(os.waitpid(program.process_id, 0)[1])
    del running[ended]
    running.pop(program.front.fileno(), None)
    _send(program.front, status.to_bytes(4, "little", signed=True))
    program.front.close()
    os.close(ended)


def _send(front: socket.socket, data: bytes) -> bool:
    """False: it was killed."""
    try:
        front.sendall(data)
    except (BrokenPipeError, ConnectionResetError):
        return False
    return True


def _hear(front: socket.socket) -> tuple[Asked | None, list[int]]:
    """What a front asks for, and its descriptors; None: it was killed meanwhile."""
    received: list[int] = []
    what = b""
    with suppress(ConnectionResetError):
        head, received, _, _ = socket.recv_fds(front, 4, _DESCRIPTORS_MAX)
        while len(head) == 4 and len(what) < int.from_bytes(head, "little"):
            if not (more := front.recv(1 << 16)):
                return None, received
            what += more
        return Asked(*marshal.loads(what)) if what else None, received
    return None, received


def _take_place(asked: Asked, received: Sequence[int]) -> None:
    """Be the process that its front would have been: its descriptors, folder, environment and streams."""
    os.setsid()
    high = [fcntl.fcntl(each, fcntl.F_DUPFD, _HIGH) for each in received]
    os.closerange(0, _HIGH)
    for place, number in zip(high, asked.descriptors, strict=True):
        os.dup2(place, number)
    os.closerange(_HIGH, 2 * _HIGH)
    os.chdir(asked.folder)
    os.environ.clear()
    os.environb.update(asked.environment)
    random.seed()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in asked.ignored:
        signal.signal(number, signal.SIG_IGN)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = _stream(number, getattr(sys, name)) if number in asked.descriptors else None
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)


def _stream(number: int, own: Any) -> TextIO:
    """One of the standard streams, as Python opens it; ``own``: the server's, by the same environment."""
    unbuffered = own.write_through
    file: Any = open(number, "wb" if number else "rb", 0 if number and unbuffered else -1, closefd=False)  # noqa: SIM115
    in_lines = own.line_buffering or (file.isatty() and not unbuffered)
    return io.TextIOWrapper(file, own.encoding, own.errors, None, in_lines, unbuffered)


def run(asked: Asked, place: Path) -> NoReturn:
    """What Python does with a program, from its first line to the end of the process."""
    sys.executable = str(place / PYTHON)
    sys.argv = [str(place / "hil"), *asked.arguments]
    if asked.module in LOGGER and asked.environment.get(b"UNVIEWED"):
        sys.modules["rerun"] = None  # type: ignore[assignment]  # as where it is not installed
    status: Any = 0
    try:
        if asked.module == "servobench.hil.cli":
            import_module(asked.module).main()
        else:
            sys.modules.pop(asked.module, None)  # else runpy would say that it is there already
            runpy.run_module(asked.module, run_name="__main__", alter_sys=True)
    except SystemExit as leaving:
        status = leaving.code
    except KeyboardInterrupt:
        traceback.print_exc()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:  # noqa: BLE001 - top of the process
        traceback.print_exc()
        status = 1
    if status is not None and not isinstance(status, int):
        print(status, file=sys.stderr)
        status = 1
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    os._exit((status or 0) & 0xFF)


def _tasks() -> list[str]:
    return os.listdir("/proc/self/task")


def _close(*descriptors: int) -> None:
    for descriptor in descriptors:
        os.close(descriptor)


def main() -> NoReturn:
    """Import, serve, and in each fork run."""
    place = Path(sys.argv[1])
    listeners = {role: socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for role in ROLES}
    for role, listener in listeners.items():
        listener.bind(str(place / role))
        listener.listen(64)
    _import("bench")
    role = "bench" if os.fork() else "logger"
    # a server that ended is refused, not waited for
    listeners.pop("logger" if role == "bench" else "bench").close()
    if role == "bench":
        os.write(1, b"ready\n")
    else:
        select.select([0, listeners[role].fileno()], [], [])  # many a test process starts no logger
        _import(role)
    run(serve(listeners[role], role, ended=0), place)


def _import(role: str) -> None:
    for module in ROLES[role]:
        import_module(module)
    gc.collect()
    gc.freeze()


if __name__ == "__main__":
    main()
