"""When the host is late, and by how much: drawn from a plan, or out of a recorded run."""

from collections.abc import Callable, Sequence
from functools import partial

from drivers.timebase import Duration, Instant
from virtual_bus.faults.fault_log import KIND_CODES, FaultLog
from virtual_bus.faults.fault_streams import uniform_stream
from virtual_bus.faults.kinds.host_stall import HostStall
from virtual_bus.faults.node_faults import Events
from virtual_bus.faults.replay import RecordedFaults

_STALL = KIND_CODES[HostStall.kind]

LateBy = Callable[[int, int], int]
"""By how much the action of that number (from 0) at that time since time zero (ns) comes late, ns."""


def drawn_stalls(stalls: Sequence[HostStall], seed: int, link: str) -> LateBy:
    """By the tables of a plan; ``link`` tells the benches' buses apart."""
    tables = [
        Events(stall.events(partial(uniform_stream, seed, f"{link}/host/{stall.kind}/{place}")))
        for place, stall in enumerate(stalls)
    ]

    def late_by(_n: int, elapsed_ns: int) -> int:
        total = 0
        for table in tables:
            longest = 0
            while table.next_at() <= elapsed_ns:
                longest = max(longest, table.take().a)
            total += longest
        return total

    return late_by


def recorded_stalls(recorded: RecordedFaults) -> LateBy:
    """As they were in a recorded run, action by action."""
    late = {entry.n: entry.a for entry in recorded.entries if entry.code == _STALL}
    return lambda n, _elapsed_ns: late.get(n, 0)


class HostStalls:
    """The lateness of a host; every stall goes into ``log``. The host is on time until ``start``."""

    def __init__(self, late_by: LateBy, log: FaultLog | None) -> None:
        self._late_by = late_by
        self._log = log
        self._zero: Instant | None = None
        self._actions = 0

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``."""
        self._zero = now
        self._actions = 0

    def stop(self) -> None:
        """From here on the host is on time."""
        self._zero = None

    def stall(self, now: Instant) -> Duration:
        """For how long the host, which should act at ``now``, sleeps instead. To be asked once an action."""
        if self._zero is None:
            return Duration(0)
        n, elapsed_ns = self._actions, now - self._zero
        self._actions = n + 1
        late_ns = self._late_by(n, elapsed_ns)
        if late_ns and self._log is not None:
            self._log.note(_STALL, elapsed_ns, 0, 0, n, late_ns)
        return Duration(late_ns)
