"""Progress of a run, on the terminal that started it.

The loop calls this from its own thread, so a call costs one short write at most:
no thread, no escape sequence but a carriage return, and nothing while the shown
percentage stays the same.
"""

from typing import Protocol, TextIO

BAR_WIDTH = 30
LINE_WIDTH = 72
"""Phase, bar and figures of a day's run take 69; a terminal has 80."""


class Progress(Protocol):
    """Called with a run's progress."""

    def __call__(self, phase: str, elapsed_s: float) -> None:
        """``phase``: the present action, e.g. "connecting", "running"; ``elapsed_s``: loop time done, s."""
        ...


def no_progress(phase: str, elapsed_s: float) -> None:
    """Ignore progress."""


class TerminalProgress:
    """A bar on one line of a terminal; a line for each phase where the stream is none."""

    def __init__(self, stream: TextIO, duration_s: float) -> None:
        self._stream = stream
        self._duration_s = duration_s
        self._on_terminal = stream.isatty()
        self._phase = ""
        self._percent = -1

    def __call__(self, phase: str, elapsed_s: float) -> None:
        """Show progress; see :class:`Progress`."""
        percent = min(100, int(100.0 * elapsed_s / self._duration_s))
        if phase == self._phase and percent == self._percent:
            return
        if self._on_terminal:
            self._write("\r" + bar_line(phase, elapsed_s, self._duration_s, percent))
        elif phase != self._phase:
            self._write(f"{phase}\n")
        self._phase, self._percent = phase, percent

    def clear(self) -> None:
        """Leave an empty line for the next output."""
        if self._on_terminal and self._percent >= 0:
            self._write("\r" + " " * LINE_WIDTH + "\r")
        self._phase, self._percent = "", -1

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def bar_line(phase: str, elapsed_s: float, duration_s: float, percent: int) -> str:
    """Return one line of :data:`LINE_WIDTH` characters: phase, bar, percent, seconds."""
    filled = BAR_WIDTH * percent // 100
    bar = "#" * filled + "." * (BAR_WIDTH - filled)
    return f"{phase[:12]:<12} {bar} {percent:3d} % {elapsed_s:8.2f} of {duration_s:g} s"[:LINE_WIDTH].ljust(
        LINE_WIDTH
    )
