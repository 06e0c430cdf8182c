"""The stages that one control cycle passes through; each has its own type."""

from enum import Enum
from typing import Final

from mypy_extensions import mypyc_attr

from servobench.drivers.exchange import Reading
from servobench.drivers.record import Record
from servobench.drivers.timebase import Instant


class DropoutCause(Enum):
    """Why a cycle has no reading of use."""

    LOST = "lost"
    """It never came within the horizon."""
    LATE = "late"
    """It came, but older than the bench's deadline."""
    STALE = "stale"
    """It came in time, but a newer one had already been used."""
    MISSED = "missed"
    """The host sent no SYNC: it was too late itself, its last SYNC was not on the bus yet, or the adapter had
    no room for it."""


@mypyc_attr(acyclic=True, free_list_len=1)
class Sample(Record):
    """A reading placed on the bench's time axis. What "sampled" means stands in docs/timing.md."""

    __match_args__ = ("sequence", "reading", "sampled_at", "sampled_at_error_ns", "certain")
    __slots__ = __match_args__

    def __init__(
        self, sequence: int, reading: Reading, sampled_at: Instant, sampled_at_error_ns: int, certain: bool
    ) -> None:
        self.sequence: Final = sequence
        """The cycle whose SYNC this reading answers."""
        self.reading: Final = reading
        self.sampled_at: Final = sampled_at
        """The end of that SYNC at the drive."""
        self.sampled_at_error_ns: Final = sampled_at_error_ns
        """Half-width of the interval that certainly holds the sampling instant."""
        self.certain: Final = certain
        """True if the data decide which SYNC it answers."""


@mypyc_attr(acyclic=True, free_list_len=1)
class Dropout(Record):
    """A cycle without a usable reading."""

    __match_args__ = ("sequence", "due_at", "cause", "certain")
    __slots__ = __match_args__

    def __init__(self, sequence: int, due_at: Instant, cause: DropoutCause, certain: bool) -> None:
        self.sequence: Final = sequence
        self.due_at: Final = due_at
        """The tick of that cycle."""
        self.cause: Final = cause
        self.certain: Final = certain
        """True if the data decide that it was this cycle's reading."""


Observation = Sample | Dropout


def without_sync(observation: Observation) -> Observation:
    """Return the observation of a cycle whose SYNC never went out."""
    if isinstance(observation, Dropout):
        return Dropout(observation.sequence, observation.due_at, DropoutCause.MISSED, True)
    return observation


@mypyc_attr(acyclic=True, free_list_len=1)
class StateEstimate(Record):
    """State that the controller is given, and the instant for which it holds."""

    __match_args__ = ("position_rad", "velocity_rad_s", "torque_nm", "valid_at", "sequence")
    __slots__ = __match_args__

    def __init__(
        self, position_rad: float, velocity_rad_s: float, torque_nm: float, valid_at: Instant, sequence: int
    ) -> None:
        self.position_rad: Final = position_rad
        self.velocity_rad_s: Final = velocity_rad_s
        self.torque_nm: Final = torque_nm
        self.valid_at: Final = valid_at
        self.sequence: Final = sequence
        """The sample that it rests on; 0 before the first."""


AT_REST: Final = StateEstimate(0.0, 0.0, 0.0, Instant(0), 0)
"""State assumed before the first sample: the loop starts with the drive at rest."""


class CommandFate(Enum):
    """Fate of a command behind the bus."""

    NOT_MEASURED = "not measured"
    """The drive does not tell which command it follows."""
    ACTING = "acting"
    """The drive followed it."""
    LOST = "lost"
    """The drive never followed it while that could be seen."""
    NOT_IDENTIFIABLE = "not identifiable"
    """It equals a neighbour, or was replaced before the drive told."""
    NOT_FOLLOWED = "not followed"
    """The drive was in another mode, or said that it ignores its target."""
    NOT_SENT = "not sent"
    """The adapter had no room for it until the next one was to be sent: queue full, or interface down."""


@mypyc_attr(acyclic=True, free_list_len=1)
class Sending(Record):
    """Knowledge of a command on its way."""

    __match_args__ = ("raw", "handed_at", "on_bus_at", "fate", "acts_after", "acts_by")
    __slots__ = __match_args__

    def __init__(
        self,
        raw: int,
        handed_at: Instant,
        on_bus_at: Instant | None,
        fate: CommandFate,
        acts_after: Instant | None,
        acts_by: Instant | None,
    ) -> None:
        self.raw: Final = raw
        """In the unit of 0x6071, 0x60FF or 0x607A."""
        self.handed_at: Final = handed_at
        self.on_bus_at: Final = on_bus_at
        """End of its frame by the echo; None without one."""
        self.fate: Final = fate
        self.acts_after: Final = acts_after
        """The latest instant known at which it did not act yet; None unless it is known to act."""
        self.acts_by: Final = acts_by
        """The earliest instant known at which it acted."""
