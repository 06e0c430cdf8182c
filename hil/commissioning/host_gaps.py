"""Intervals in which the host gave no sign of life for longer than its drive tolerates."""

from collections.abc import Iterator
from contextlib import contextmanager

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration


class HostStoodStill(PeerFault):
    """The drive considered the host lost, and stopped: measurements meanwhile are worthless."""


class HostGaps:
    """Gaps of the attempts at a step, one after the other."""

    def __init__(self, network: CanopenNetwork, borne_ms: int) -> None:
        """``borne_ms``: silence of the host that the drive tolerates."""
        self._signs = network.life_signs
        self._borne_ms = borne_ms
        self._longest_ns = 0

    def begin(self) -> None:
        """Begin an attempt."""
        self._longest_ns = self._signs.longest_gap_ns = Duration(0)

    @contextmanager
    def while_enabled(self) -> Iterator[None]:
        """Inside, gaps count that a drive at rest would not mind; raises HostStoodStill at the end if there
        was one."""
        self._longest_ns = max(self._longest_ns, self._signs.longest_gap_ns)
        self._signs.longest_gap_ns = Duration(0)
        yield
        if self._too_long(self._signs.longest_gap_ns):
            raise self._stood_still(self._signs.longest_gap_ns)

    def cause_of(self, failure: PeerFault | None) -> PeerFault | None:
        """Return the cause of a failed attempt: the host's own silence takes precedence."""
        longest_ns = max(self._longest_ns, self._signs.longest_gap_ns)
        if failure is None or isinstance(failure, HostStoodStill) or not self._too_long(longest_ns):
            return failure
        return self._stood_still(longest_ns, f"; then: {failure}")

    def _too_long(self, gap_ns: int) -> bool:
        return gap_ns > self._borne_ms * NS_PER_MS

    def _stood_still(self, gap_ns: int, then: str = "") -> HostStoodStill:
        return HostStoodStill(
            f"the host stood still for {gap_ns / NS_PER_S:.2f} s",
            f"the drive bears {self._borne_ms} ms without it{then}",
            "repeat the step; is the machine busy with something else?",
        )
