"""Serves a recording, or a run that goes on, to browsers and viewers of this machine:
``python -m servobench.hil.recording.serving OPTION...`` is Rerun's command, and ends with who started it.

``rerun.serve_web_viewer`` listens on every interface of the machine; the command takes an address.
"""

import ctypes
import os
import signal
import socket
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from servobench.hil.rows.recording_plan import LOOPBACK, ServedPorts
from servobench.virtual_bus.child_python import python_command, python_environment

_USUAL: Final = ServedPorts(9876, 9090)
"""Rerun's own."""
_BESIDE_BYTES: Final = 256 << 20
"""Room of a server beside twice its file: it drops the oldest rows where they do not fit."""
_START_MAX_NS: Final = 30 * NS_PER_S
"""A viewer starts in a second or two; on a busy machine without a GPU in ten."""
_POLL_NS: Final = 200 * NS_PER_MS
_PR_SET_PDEATHSIG: Final = 1
"""<linux/prctl.h>"""


def choose_ports() -> ServedPorts:
    """Return Rerun's usual ports, or others where somebody listens on these."""
    return ServedPorts(*(number if _is_free(number) else free_port() for number in _USUAL))


def free_port() -> int:
    """Return a port of the loopback that nobody listens on; Rerun tells none of its own choice."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
        return port


def serve_stream(ports: ServedPorts) -> "subprocess.Popen[bytes]":
    """Start the page for browsers on a stream that another process serves."""
    return _start("--web-viewer-port", str(ports.page), ports.stream_uri)


def serve_file(ports: ServedPorts, recording: Path) -> "subprocess.Popen[bytes]":
    """Start the page for browsers, and the stream for it and for viewers, on a file."""
    room = 2 * recording.stat().st_size + _BESIDE_BYTES
    return _start(
        *("--port", str(ports.stream), "--web-viewer-port", str(ports.page)),
        *("--server-memory-limit", f"{room}B", str(recording.resolve())),
    )


def comes_to_listen(process: "subprocess.Popen[bytes]", port: int) -> bool:
    """Wait until the process listens at a port; False if it ends before, or does not come to it."""
    clock = MonotonicClock()
    deadline = clock.now() + _START_MAX_NS
    while clock.now() < deadline and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((LOOPBACK, port)) == 0:
                return True
        clock.sleep_until(Instant(clock.now() + _POLL_NS))
    return False


def _start(*options: str) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        python_command(__name__, "--serve-web", "--bind", LOOPBACK, *options),
        env=python_environment(CI="1", RUST_LOG="error"),  # no analytics; nobody reads what it tells
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
    return True


def main() -> None:
    """Become Rerun's command, whose own front would outlive its parent."""
    found = find_spec("rerun_cli")
    assert found is not None
    program = str(Path(str(found.origin)).parent / "rerun")
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    os.execv(program, [program, *sys.argv[1:]])


if __name__ == "__main__":
    main()
