"""Decides when the shaft of a drive counts as at rest: it is slow, and stays slow."""

from collections.abc import Callable
from typing import Final

from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.readings import ReadingAssembler
from servobench.drivers.cia402.state_control import StateControl
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant

REST_RAD_S: Final = 1.0
"""Speed below which a shaft counts as slow."""
REST_FOR: Final = Duration(100 * NS_PER_MS)
"""A shaft that is slow for this long is at rest. A single slow reading may come from a reversal, or from a
load that begins to turn it: 0.01 N m give the motor of [Ling2012] 1 rad/s in 80 ms."""
REST_POLL: Final = Duration(10 * NS_PER_MS)
"""Ten readings in :data:`REST_FOR`. Statusword and speed are four frames of at most 135 bits: a twentieth of
1 Mbit/s, below half of 125 kbit/s."""


def slow(objects: RemoteObjects, assembler: ReadingAssembler | None) -> bool:
    """Return True if 0x606C is slow now; a drive that was never configured was never moved by this bench."""
    if assembler is None:
        return True
    raw = objects.read(Object.VELOCITY_ACTUAL_VALUE, 0, "i")
    return abs(raw * assembler.scaling.velocity_rad_s) < REST_RAD_S


def calms(objects: RemoteObjects, assembler: ReadingAssembler | None) -> Callable[[], bool]:
    """Return a function to poll; true once two readings in a row were slow: a steep ramp passes through zero,
    and a drive disabled in that moment lets the shaft run on."""
    before = False

    def calm() -> bool:
        nonlocal before
        last, before = before, slow(objects, assembler)
        return last and before

    return calm


def resting_since(control: StateControl, assembler: ReadingAssembler | None, deadline: Instant) -> Instant:
    """Wait until every reading has been slow for :data:`REST_FOR`; return when that began.

    Raises DriveInFault if the shaft still turns at the deadline, PeerFault if the drive does not report.
    """
    now = control.network.clock.now
    since = now()
    while True:
        if not slow(control.objects, assembler):
            since = now()
            if since >= deadline:
                raise control.stuck("stay at rest")
        if now() - since >= REST_FOR:
            return since
        control.network.pump(control.network.deadline_after(REST_POLL))
