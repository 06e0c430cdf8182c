"""The line between a simulated serial device and its pseudo-terminal: its pace, its faults, its bounds."""

from collections import deque

from drivers.timebase import NS_PER_MS, Instant
from virtual_bus.instruments.serial_line.line_faults import LineFaults, LineSpoiler
from virtual_bus.instruments.serial_line.pseudo_terminal import READ_BYTES, PseudoTerminal

OUTPUT_BYTES_MAX = 1 << 16
"""What waits for a host that does not read; a line beyond it is lost."""
_PACED_BYTES = 16
"""Read at a time from a line that has a speed, as from the FIFO of a UART."""


class DeviceLine:
    """Bytes in and lines out, at the speed of the line; nothing here waits."""

    def __init__(self, terminal: PseudoTerminal, faults: LineFaults, seed: int) -> None:
        self.terminal = terminal
        self.spoiler = LineSpoiler(faults, seed)
        self.lines_lost = 0
        """Lines for which the host left no room."""
        self._faults = faults
        self._output: deque[tuple[Instant, bytes]] = deque()
        self._output_bytes = 0
        self._output_free_at = Instant(0)
        self._readable_at = Instant(0)
        self._unplug_at: Instant | None = None
        self._started = False

    def start(self, now: Instant) -> None:
        """The device's start, from which an unplugging counts."""
        self._started = True
        self._unplug_at = self._faults.goes_at(now)

    def read(self, now: Instant) -> bytes:
        """What the host sent and the line has carried by ``now``."""
        if now < self._readable_at:
            return b""
        self._readable_at = Instant(0)
        paced = bool(self._faults.baud)
        data = self.terminal.read(_PACED_BYTES if paced else READ_BYTES)
        if paced and data:
            self._readable_at = Instant(now + self._faults.time_on_line(len(data)))
        return self.spoiler.lose(data)

    def send(self, line: bytes, now: Instant) -> bool:
        """Queue a line for the host, spoilt as the faults have it; False if there was no room."""
        data = self.spoiler.spoil(line)
        if self._output_bytes + len(data) > OUTPUT_BYTES_MAX:
            self.lines_lost += 1
            return False
        start = max(Instant(now + round(self._faults.late_ms * NS_PER_MS)), self._output_free_at)
        self._output_free_at = due = Instant(start + self._faults.time_on_line(len(data)))
        if data:
            self._output.append((due, data))
            self._output_bytes += len(data)
        self.flush(now)
        return True

    def flush(self, now: Instant) -> None:
        """Hand over what is due, as far as the pseudo-terminal has room; go away when that is due."""
        if self._unplug_at is not None and now >= self._unplug_at:
            self.terminal.unplug()
        while self._output and self._output[0][0] <= now:
            due, data = self._output[0]
            taken = self.terminal.write(data)
            self._output_bytes -= taken
            if taken < len(data):
                self._output[0] = (due, data[taken:])
                return
            self._output.popleft()

    def holds_back(self, now: Instant) -> bool:
        """The line is still busy with what the host sent before."""
        return now < self._readable_at

    @property
    def blocked(self) -> bool:
        """The pseudo-terminal has no room for what is due."""
        return bool(self._output)

    def due_at(self) -> Instant | None:
        """When something is to be done that no descriptor shows; None: nothing."""
        dues = [self._output[0][0]] if self._output else []
        if self._readable_at:
            dues.append(self._readable_at)
        if self._unplug_at is not None:
            dues.append(self._unplug_at)
        return min(dues, default=None)
