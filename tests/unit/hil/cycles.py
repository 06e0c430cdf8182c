"""Cycles for controllers and compensators without a loop around them."""

from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.loop.protocol import Context, Controller, TorqueSetPoint
from servobench.hil.loop.samples import AT_REST, StateEstimate
from servobench.hil.loop.scenario import ReferenceProfile

PERIOD = Duration(NS_PER_MS)
START = Instant(0)


def in_cycle(
    estimate: StateEstimate = AT_REST, reference_rad_s: float = 0.0, acts_at: Instant = START
) -> Context:
    """A cycle of 1 ms of an axis with this estimate."""
    context = Context(PERIOD, ReferenceProfile([]))
    context.begin(max(1, estimate.sequence), Instant(0), 0.0, reference_rad_s, acts_at, acts_at)
    context.estimate = estimate
    return context


def torque_of(controller: Controller, estimate: StateEstimate, reference_rad_s: float = 0.0) -> float:
    """What it asks for in such a cycle, N m."""
    asked = controller.output(in_cycle(estimate, reference_rad_s))
    assert isinstance(asked, TorqueSetPoint)
    return asked.torque_nm


def advance(controller: Controller, estimate: StateEstimate, torque_nm: float) -> None:
    """End such a cycle, in which this torque was sent."""
    command = Command(estimate.sequence, torque_nm, Instant(0), Instant(0))
    controller.update(in_cycle(estimate), command)
