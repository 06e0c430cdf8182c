"""Roles beside an axis: its compensator, its controller and its load machine.

The first two are version 1 of the protocol for controllers of one's own, ``docs/control.md``.

Context of a controller and a compensator in a cycle, and the answer of a controller.
"""

import math
from collections.abc import Sequence
from typing import Final, Protocol

from mypy_extensions import mypyc_attr

from servobench.drivers.errors import BenchError
from servobench.drivers.exchange import Command
from servobench.drivers.record import Record
from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.hil.loop.samples import AT_REST, Sample, StateEstimate
from servobench.hil.loop.scenario import ReferenceProfile

CHANNELS_MAX: Final = 8
"""Values of its own that a controller may tell in a cycle: each costs 8 bytes of every row of every run."""


class WrongSetPoint(BenchError):
    """A controller's answer is not of the quantity that its axis takes, or is none at all."""


class SetPoint(Record):
    """A controller's demand on its drive; one of the three below."""


class TorqueSetPoint(SetPoint):
    """For an axis that is given torques."""

    __match_args__ = ("torque_nm",)
    __slots__ = __match_args__

    def __init__(self, torque_nm: float) -> None:
        self.torque_nm: Final = torque_nm


class SpeedSetPoint(SetPoint):
    """For an axis that is given speeds."""

    __match_args__ = ("speed_rad_s",)
    __slots__ = __match_args__

    def __init__(self, speed_rad_s: float) -> None:
        self.speed_rad_s: Final = speed_rad_s


class PositionSetPoint(SetPoint):
    """For an axis that is given positions."""

    __match_args__ = ("position_rad",)
    __slots__ = __match_args__

    def __init__(self, position_rad: float) -> None:
        self.position_rad: Final = position_rad


class Context:
    """The present cycle of one axis. One object for the whole run: what it holds is of this cycle alone."""

    __slots__ = (
        "_reference",
        "_time_s",
        "acts_at",
        "dropouts",
        "due_at",
        "estimate",
        "follows",
        "newest",
        "now",
        "period",
        "reference_nm",
        "reference_rad",
        "reference_rad_s",
        "samples",
        "sent",
        "sequence",
    )

    def __init__(self, period: Duration, reference: ReferenceProfile) -> None:
        self._reference = reference
        self._time_s = 0.0
        self.period: Final = period
        """Period of the loop, ns."""
        self.sequence = 0
        """Number of the cycle, from 1."""
        self.due_at = Instant(0)
        """The tick of the cycle."""
        self.now = Instant(0)
        """The present instant on the bench's clock, ns; in simulated time that of the last frame."""
        self.acts_at = Instant(0)
        """When the command of this cycle is meant to act on the drive."""
        self.estimate: StateEstimate = AT_REST
        """The compensator's, for a controller; for a compensator the one before."""
        self.samples: list[Sample] = []
        """The usable readings that have come since the last cycle, in the order in which they came."""
        self.newest: Sample | None = None
        """The last of all of them; None before the first."""
        self.dropouts = 0
        """Cycles in a row, up to this one, in which no usable reading has come."""
        self.follows = True
        """True if the drive follows its commands, as far as it tells. While it does not, ``update`` and
        ``sent`` are given what acts in place of the command, and the reference is where the shaft is; from
        there it comes back afterwards, see :mod:`servobench.hil.loop.way_back`."""
        self.sent: Command | None = None
        """The last command that was handed to the bus, after all limits; None before the first."""
        self.reference_rad_s = 0.0
        """The speed that is asked for now; of a position reference its rate, NaN of a torque reference."""
        self.reference_rad = math.nan
        """The position that is asked for now, counted as in a reading; NaN of any other reference."""
        self.reference_nm = math.nan
        """The torque that is asked for now; NaN of any other reference."""

    def ask(self, reference: ReferenceProfile) -> None:
        """From now on it is asked for what ``reference`` has; for the axis alone to call."""
        self._reference = reference

    def begin(
        self,
        sequence: int,
        due_at: Instant,
        time_s: float,
        reference_rad_s: float,
        now: Instant,
        acts_at: Instant,
    ) -> None:
        """A decision begins, in the cycle due at ``due_at``, which is ``time_s`` after the first one; for the
        axis alone to call."""
        self.sequence = sequence
        self.due_at = due_at
        self._time_s = time_s
        self.reference_rad_s = reference_rad_s
        self.now = now
        self.acts_at = acts_at
        if self.samples:
            self.newest = self.samples[-1]
            self.dropouts = 0
        else:
            self.dropouts += 1

    def preview(self, periods: int) -> list[float]:
        """Return the references of this cycle and of the ``periods`` after it: speeds, rad/s, or what else
        the reference is of, positions, rad, or torques, N m."""
        period_s = self.period / NS_PER_S
        return [self._reference.value(self._time_s + ahead * period_s) for ahead in range(periods + 1)]

    def reference_at(self, instant: Instant) -> float:
        """Return the reference at an instant, past or to come; units as of :meth:`preview`."""
        return self._reference.value(self._time_s + (instant - self.due_at) / NS_PER_S)

    def reference_rate_at(self, instant: Instant) -> float:
        """The change of that per second; of a position the speed, rad/s. A jump has none."""
        return self._reference.rate(self._time_s + (instant - self.due_at) / NS_PER_S)


PROTOCOL_VERSION = 1


@mypyc_attr(allow_interpreted_subclasses=True)
class Compensator:
    """Turns samples of varying age, some missing, into the state that a command is based on.

    Override ``estimate`` and, mostly, ``receive``.
    """

    def reset(self) -> None:
        """The first cycle is about to begin."""

    def receive(self, sample: Sample) -> None:
        """A usable sample has come; called for each, in order of arrival."""

    def estimate(self, context: Context) -> StateEstimate:
        """The state to base a command on that will act at ``context.acts_at``."""
        raise NotImplementedError

    def sent(self, command: Command) -> None:
        """This command, after all limits, was handed to the bus."""


@mypyc_attr(allow_interpreted_subclasses=True)
class Controller:
    """A controller of one axis. Override ``output``, and what else is needed.

    ``output`` is called first and its set-point is sent at once; ``update`` does the
    bookkeeping afterwards, with the command that the safety limits let through.
    Neither reads a clock: the context has all instants.
    """

    def channels(self) -> Sequence[str]:
        """Names of values of its own that are recorded, at most 8, the unit last: ``load_torque_nm``."""
        return ()

    def observer(self) -> Compensator | None:
        """A compensator of its own, in place of the bench's; None: it takes what it is given."""
        return None

    def reset(self) -> None:
        """The first cycle is about to begin."""

    def output(self, context: Context) -> SetPoint:
        """The set-point before any limit. Changes nothing that the next call depends on."""
        raise NotImplementedError

    def update(self, context: Context, command: Command) -> None:
        """Advance by one period. ``command``: what this cycle's set-point became by the limits."""

    def telemetry(self) -> Sequence[float]:
        """The values of its channels in this cycle, in their order; asked after ``update``."""
        return ()


class LoadMachine(Protocol):
    """A load on the shaft."""

    def set_torque(self, torque_nm: float) -> None:
        """Ask for a load torque, N m; positive opposes positive speed. Does not block."""
        ...
