"""Ctrl-C, SIGTERM and SIGHUP as a request to end, never as an exception in the middle of a cycle."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from drivers.errors import BenchError

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(BenchError):
    """The user asked for the end before the run had begun."""

    exit_status = 130


class StopRequest:
    """Whether somebody has asked this process to end, and how."""

    def __init__(self) -> None:
        self.signal_name = ""

    def __call__(self) -> bool:
        """True once a stop signal has come."""
        return bool(self.signal_name)

    def check(self) -> None:
        """Raises Interrupted once a stop signal has come: for the steps before the loop."""
        if self.signal_name:
            raise Interrupted(f"ended by {self.signal_name}")

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self.signal_name = signal.Signals(number).name


@contextmanager
def stop_signals() -> Iterator[StopRequest]:
    """Inside, stop signals are noted instead of acted on; the handlers of before return afterwards.

    Only the main thread of a process can be asked so (:func:`signal.signal`); in another one signals are
    left to whoever owns the process.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    before = {number: signal.signal(number, request._note) for number in STOP_SIGNALS}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
