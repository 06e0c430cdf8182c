"""Ctrl-C, SIGTERM and SIGHUP as a request to end, never as an exception in the middle of a cycle."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from servobench.drivers.errors import BenchError

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def heard_signals() -> tuple[signal.Signals, ...]:
    """STOP_SIGNALS, without SIGHUP where ``nohup`` has it ignored: such a command outlives its terminal."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return tuple(number for number in STOP_SIGNALS if number != signal.SIGHUP or not ignored)


class Interrupted(BenchError):
    """Somebody asked for the end before the run had begun."""

    exit_status = 130


class StopRequest:
    """Whether somebody has asked for the end, and who."""

    def __init__(self) -> None:
        self.asked_by = ""
        """A stop signal, or whoever called :meth:`ask`; empty: nobody has."""

    def __call__(self) -> bool:
        """True once somebody has asked."""
        return bool(self.asked_by)

    def ask(self, asked_by: str = "its caller") -> None:
        """Ask for the end; from any thread."""
        self.asked_by = asked_by

    def check(self) -> None:
        """Raises Interrupted once somebody has asked: for the steps before the loop."""
        if self.asked_by:
            raise Interrupted(f"ended by {self.asked_by}")


@contextmanager
def stop_signals(stop: StopRequest | None = None) -> Iterator[StopRequest]:
    """Inside, stop signals are noted instead of acted on; the handlers of before return afterwards.

    Only the main thread of a process can be asked so (:func:`signal.signal`); in another one signals are
    left to whoever owns the process, who asks by ``stop``.
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
