"""One cycle of an axis while it is in the making: its tick, what is asked for, what was done."""

from collections.abc import Sequence

from mypy_extensions import mypyc_attr

from servobench.drivers.exchange import Command, SentCommand
from servobench.drivers.timebase import Instant
from servobench.hil.loop.delay import Fate
from servobench.hil.loop.samples import StateEstimate
from servobench.hil.loop.syncs import SyncMark


@mypyc_attr(acyclic=True, free_list_len=1)
class Tick:
    """Data that all axes of a cycle share."""

    def __init__(self, sequence: int, due_at: Instant, woke_at: Instant | None, time_s: float) -> None:
        """``woke_at``: None for a tick for which the host was not there; ``time_s``: since the run began."""
        self.sequence = sequence
        self.due_at = due_at
        self.woke_at = woke_at
        self.time_s = time_s


@mypyc_attr(free_list_len=1)
class Decision:
    """Acts of one cycle, while the fates of its reading and of its command may still be open."""

    def __init__(self, tick: Tick, reference_rad_s: float, load_torque_nm: float) -> None:
        self.tick = tick
        self.reference_rad_s = reference_rad_s
        self.reference_rad: float | None = None
        self.reference_nm: float | None = None
        self.load_torque_nm = load_torque_nm
        self.mark: SyncMark | None = None
        self.estimate: StateEstimate | None = None
        self.command: Command | None = None
        self.sent: SentCommand | None = None
        self.fate: Fate | None = None
        self.follows = True
        """The drive followed its commands."""
        self.compute_ns: int | None = None
        self.channels: Sequence[float] = ()
        self.following: Decision | None = None
        """The next one of the same :class:`Decisions`."""


class Decisions:
    """Decisions in their order. A chain: for a list to give its first away takes ten times as long."""

    def __init__(self) -> None:
        self.first: Decision | None = None
        self._last: Decision | None = None

    def newest(self) -> Decision:
        assert self._last is not None
        return self._last

    def append(self, decision: Decision) -> None:
        if self._last is None:
            self.first = decision
        else:
            self._last.following = decision
        self._last = decision

    def take_first(self) -> Decision:
        decision = self.first
        assert decision is not None
        self.first, decision.following = decision.following, None
        if self.first is None:
            self._last = None
        return decision
