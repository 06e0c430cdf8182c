"""Roles beside an axis: its compensator, its controller and its load machine.

The first two are version 1 of the protocol for controllers of one's own, ``docs/control.md``.
"""

from collections.abc import Sequence
from typing import Protocol

from mypy_extensions import mypyc_attr

from servobench.drivers.exchange import Command
from servobench.hil.loop.context import Context, SetPoint
from servobench.hil.loop.samples import Sample, StateEstimate

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
