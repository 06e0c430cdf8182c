"""Ctrl-C, SIGTERM and SIGHUP as a request to end, never as an exception in the middle of a cycle."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from servobench.drivers.errors import BenchError

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def heard_signals() -> tuple[signal.Signals, ...]:
    """Return STOP_SIGNALS, without SIGHUP if ``nohup`` has it ignored: such a command outlives its
    terminal."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return tuple(number for number in STOP_SIGNALS if number != signal.SIGHUP or not ignored)


class Interrupted(BenchError):
    """The end was requested before the run had begun."""

    exit_status = 130


class StopRequest:
    """A request for the end, and its source."""

    def __init__(self) -> None:
        self.asked_by = ""
        """A stop signal, or the caller of :meth:`ask`; empty: no request."""

    def __call__(self) -> bool:
        """Return True once the end is requested."""
        return bool(self.asked_by)

    def ask(self, asked_by: str = "its caller") -> None:
        """Request the end; from any thread."""
        self.asked_by = asked_by

    def check(self) -> None:
        """Raise Interrupted once the end is requested: for the steps before the loop."""
        if self.asked_by:
            raise Interrupted(f"ended by {self.asked_by}")


@contextmanager
def stop_signals(stop: StopRequest | None = None) -> Iterator[StopRequest]:
    """Inside, stop signals are noted instead of acted on; the former handlers return afterwards.

    Only the main thread of a process can do this (:func:`signal.signal`); in another one signals are left to
    the owner of the process, who requests the end by ``stop``.
    """
    request = StopRequest() if stop is None else stop
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def note(number: int, _frame: FrameType | None) -> None:
        request.ask(signal.Signals(number).name)

    before = {number: signal.signal(number, note) for number in heard_signals()}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
