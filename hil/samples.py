"""The stages that one control cycle passes through; each has its own frozen type.

They are named tuples: as immutable as a frozen dataclass, and a fifth of its cost
to build, which counts in a loop that runs many times faster than real time.
"""

from enum import Enum
from typing import Final, NamedTuple

from drivers.exchange import Command, Reading
from drivers.timebase import Duration, Instant

_new: Final = tuple.__new__
"""As in :mod:`drivers.exchange`."""


class DropoutCause(Enum):
    """Why a cycle has no reading of use."""

    LOST = "lost"
    """It never came within the horizon."""
    LATE = "late"
    """It came, but older than the bench's deadline."""
    STALE = "stale"
    """It came in time, but a newer one had already been used."""
    MISSED = "missed"
    """The host sent no SYNC: it was too late itself, or its last SYNC was not on the bus yet."""


class Sample(NamedTuple):
    """A reading placed on the bench's time axis. What "sampled" means stands in docs/timing.md."""

    sequence: int
    """The cycle whose SYNC this reading answers."""
    reading: Reading
    sampled_at: Instant
    """The end of that SYNC at the drive."""
    sampled_at_error_ns: int
    """Half-width of the interval that certainly holds the sampling instant."""
    certain: bool
    """Whether the data decide which SYNC it answers."""


def new_sample(
    sequence: int, reading: Reading, sampled_at: Instant, sampled_at_error_ns: int, certain: bool
) -> Sample:
    """A :class:`Sample`; see :func:`drivers.exchange.new_reading`."""
    return _new(Sample, (sequence, reading, sampled_at, sampled_at_error_ns, certain))


class Dropout(NamedTuple):
    """A cycle without a usable reading."""

    sequence: int
    due_at: Instant
    """The tick of that cycle."""
    cause: DropoutCause
    certain: bool
    """Whether the data decide that it was this cycle's reading."""


Observation = Sample | Dropout


class StateEstimate(NamedTuple):
    """What the controller is given: the state, and the instant for which it holds."""

    position_rad: float
    velocity_rad_s: float
    torque_nm: float
    valid_at: Instant
    sequence: int
    """The sample that it rests on; 0 before the first."""


def new_estimate(
    position_rad: float, velocity_rad_s: float, torque_nm: float, valid_at: Instant, sequence: int
) -> StateEstimate:
    """As :func:`new_sample`."""
    return _new(StateEstimate, (position_rad, velocity_rad_s, torque_nm, valid_at, sequence))


class CommandFate(Enum):
    """What became of a command behind the bus."""

    NOT_MEASURED = "not measured"
    """The drive does not tell which command it follows."""
    ACTING = "acting"
    """The drive followed it."""
    LOST = "lost"
    """The drive never followed it while that could be seen."""
    NOT_IDENTIFIABLE = "not identifiable"
    """It equals a neighbour, or was replaced before the drive told."""


class Sending(NamedTuple):
    """What is known of a command on its way."""

    raw: int
    """In the unit of 0x6071."""
    handed_at: Instant
    on_bus_at: Instant | None
    """End of its frame by the echo; None without one."""
    fate: CommandFate
    acts_after: Instant | None
    """The latest instant known at which it did not act yet; None unless it is known to act."""
    acts_by: Instant | None
    """The earliest instant known at which it acted."""


def new_sending(
    raw: int,
    handed_at: Instant,
    on_bus_at: Instant | None,
    fate: CommandFate,
    acts_after: Instant | None,
    acts_by: Instant | None,
) -> Sending:
    """As :func:`new_sample`."""
    return _new(Sending, (raw, handed_at, on_bus_at, fate, acts_after, acts_by))


class CycleRecord(NamedTuple):
    """Everything about one planned cycle of one axis: what came of its SYNC, and what was done in it."""

    sequence: int
    """The cycle's number on the grid of ticks, from 1."""
    axis: int
    due_at: Instant
    woke_at: Instant | None
    """None if the host was not there at all."""
    sync_handed_at: Instant | None
    """None for a cycle without SYNC."""
    sync_on_bus_at: Instant | None
    """None if it is not known to have come there."""
    observation: Observation
    """The fate of this cycle's own reading."""
    delay: Duration | None
    """Sampled to received, of this cycle's own reading; None for one that never came."""
    estimate: StateEstimate | None
    """None, like all that follows but reference and load, where nothing was decided."""
    reference_rad_s: float
    load_torque_nm: float
    command: Command | None
    sending: Sending | None
    """None if the command was not sent."""
    clock_offset_ns: int | None
    """Host minus drive, by the map of the drive's clock; None for a drive without one."""
    clock_error_ns: int | None


def new_record(
    sequence: int,
    axis: int,
    due_at: Instant,
    woke_at: Instant | None,
    sync_handed_at: Instant | None,
    sync_on_bus_at: Instant | None,
    observation: Observation,
    delay: Duration | None,
    estimate: StateEstimate | None,
    reference_rad_s: float,
    load_torque_nm: float,
    command: Command | None,
    sending: Sending | None,
    clock_offset_ns: int | None,
    clock_error_ns: int | None,
) -> CycleRecord:
    """As :func:`new_sample`."""
    return _new(
        CycleRecord,
        (
            sequence,
            axis,
            due_at,
            woke_at,
            sync_handed_at,
            sync_on_bus_at,
            observation,
            delay,
            estimate,
            reference_rad_s,
            load_torque_nm,
            command,
            sending,
            clock_offset_ns,
            clock_error_ns,
        ),
    )
