"""The stages that one control cycle passes through; each has its own frozen type.

They are named tuples: as immutable as a frozen dataclass, and a fifth of its cost
to build, which counts in a loop that runs many times faster than real time.
"""

from enum import Enum
from typing import NamedTuple

from drivers.exchange import Command, Reading
from drivers.timebase import Duration, Instant


class DropoutCause(Enum):
    """Why a cycle's reading was of no use."""

    LOST = "lost"
    """It never came within the horizon."""
    LATE = "late"
    """It came, but older than the bench's deadline."""
    STALE = "stale"
    """It came in time, but a newer one had already been used, or it repeats one."""


class Sample(NamedTuple):
    """A reading placed on the bench's time axis."""

    sequence: int
    """The SYNC that this reading answers."""
    reading: Reading
    sampled_at: Instant
    sampled_at_error_ns: int
    """Half-width of the interval that certainly holds the sampling instant."""


class Dropout(NamedTuple):
    """A cycle without a usable reading."""

    sequence: int
    due_at: Instant
    cause: DropoutCause


Observation = Sample | Dropout


class StateEstimate(NamedTuple):
    """What the controller is given: the state, and the instant for which it holds."""

    position_rad: float
    velocity_rad_s: float
    torque_nm: float
    valid_at: Instant
    sequence: int
    """The sample that it rests on; 0 before the first."""


class CycleRecord(NamedTuple):
    """Everything about one cycle of one axis, complete: what came of its SYNC, and what was done in it."""

    sequence: int
    axis: int
    due_at: Instant
    woke_at: Instant
    sync_sent_at: Instant
    observation: Observation
    """The fate of this cycle's own reading."""
    delay: Duration
    """Sampled to received, of this cycle's own reading; -1 for one that was lost."""
    estimate: StateEstimate
    reference_rad_s: float
    load_torque_nm: float
    command: Command
    command_sent_at: Instant
    """-1 if the command was not sent."""
