"""What an axis asks of its compensator, its controller and its load machine."""

from typing import Protocol

from drivers.exchange import Command
from drivers.timebase import Instant
from hil.loop.samples import Sample, StateEstimate


class Compensator(Protocol):
    """Turns samples of varying age, some missing, into the state that a command is based on."""

    def receive(self, sample: Sample) -> None:
        """A usable sample has come; called for each, in order of arrival."""
        ...

    def estimate(self, apply_at: Instant) -> StateEstimate:
        """The state to base a command on that will act at ``apply_at``."""
        ...


class Controller(Protocol):
    """A speed controller of one axis; of one that is given speeds, what says them.

    ``output`` is called first and its set-point is sent at once; ``update`` does the
    bookkeeping afterwards, with the command that the safety limits let through.
    Neither reads a clock: time comes from the estimate and from the loop's period.
    """

    def output(self, estimate: StateEstimate, reference_rad_s: float) -> float:
        """The set-point before any limit: torque, N m; of an axis under limits of speed, rad/s. Changes
        nothing."""
        ...

    def update(self, estimate: StateEstimate, command: Command) -> None:
        """Advance the controller's states by one period, knowing what was really sent."""
        ...


class LoadMachine(Protocol):
    """What puts a load on the shaft."""

    def set_torque(self, torque_nm: float) -> None:
        """Ask for a load torque, N m; positive opposes positive speed. Does not block."""
        ...
