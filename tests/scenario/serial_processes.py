"""``hil adapter`` as a process, for the tests of the serial path."""

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

from tests.scenario.processes import START_LIMIT_S
from tests.warm.start import hil


class AdapterProcess:
    """An emulated adapter that is running; ``bus`` is what to hand to --bus."""

    def __init__(self, process: subprocess.Popen[str], port: str) -> None:
        self.process = process
        self.port = port
        self.bus = f"slcan:{port}"

    def pull_out(self) -> None:
        """The adapter is gone from one moment to the next, as when its cable is pulled."""
        self.process.kill()
        self.process.wait(START_LIMIT_S)


@contextmanager
def adapter_process(bus: str, *options: str) -> Iterator[AdapterProcess]:
    """``hil adapter`` on ``bus``, ready when entered, ended when left."""
    command = [*hil(), "adapter", "--bus", bus, *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        port = process.stdout.readline().strip()
        if not port:
            raise AssertionError(f"hil adapter ended with {process.wait()}: {process.communicate()[1]}")
        yield AdapterProcess(process, port)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=START_LIMIT_S)
        assert process.returncode in (0, -signal.SIGKILL), said
