"""Lines from a pipe without waiting for them; a buffer of the interpreter's would hide what has come."""

import os
import select


class LineReader:
    """The reading end of a pipe."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._held = b""
        self.ended = False
        """Nobody writes any more."""

    def line(self, timeout_s: float) -> str | None:
        """The next whole line; None if it has not come in time, or never will."""
        if (
            b"\n" not in self._held
            and not self.ended
            and select.select([self._descriptor], [], [], timeout_s)[0]
        ):
            read = os.read(self._descriptor, 1 << 16)
            self.ended = not read
            self._held += read
        line, separator, rest = self._held.partition(b"\n")
        if not separator:
            return None
        self._held = rest
        return line.decode()
