"""The step of ``hil brake --test``: the holding brake set against the motor, then released by the drive.

60FEh:1 = 1, :2 = 1   the master sets the brake; the drive is enabled and pushes against it, both ways
60FEh as found        the drive releases it as it is enabled; the shaft has to turn
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Final

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import LimitExceeded
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.request import PlateLimits
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_manual import ManualStep, SpeedUnits, set_up_steps
from servobench.hil.loop.scenario import Quantity, Ramp, Segment

_SET_BRAKE: Final = 1
"""Bit 0 of 60FEh:1 and :2 (CiA 402-2, digital outputs)."""
_RPM: Final = 30.0
"""At which the drive pushes; its speed loop raises the torque to the limit within some tenths of a second."""
_PUSH_S: Final = 1.5
_REACHED: Final = 0.9
"""Share of the torque limit that a push has to reach: 6072h is a whole number of thousandths."""
_FREE_TURNS: Final = 0.1
"""Path each way over which the released shaft turns."""
_ROOM_TURNS: Final = 0.5


def brake_limits(torque_percent: float) -> PlateLimits:
    """Return the limits of the test."""
    return PlateLimits(speed_max_rpm=_RPM, torque_max_percent=torque_percent, turns_max=_ROOM_TURNS)


class BrakeUnits(SpeedUnits):
    """Only a drive's own speed loop raises its torque against a shaft that stands."""

    modes = tuple(mode for mode, quantity in QUANTITY_OF_MODE.items() if quantity is Quantity.SPEED)


class BrakeTest(ManualStep):
    """Pushes against the brake, and turns the shaft without it."""

    name = "brake"
    title = "Holding brake"
    limit = "the shaft slips while the brake is set, or stands while the drive has released it"

    def __init__(self, slip_deg: float) -> None:
        """``slip_deg``: by which the shaft may turn in its play and the brake's."""
        self._slip_deg = slip_deg

    def lack(self, session: Session) -> str:
        return "" if self._outputs(session) else "the drive has no brake output (60FEh:1 and :2)"

    def plan(self, session: Session, /) -> str:
        return (
            "set the brake by 60FEh, enable the drive, and push both ways with "
            f"{session.limits.torque_nm:.4g} N m for {_PUSH_S:g} s: the shaft may slip by "
            f"{self._slip_deg:g} degrees; then leave the brake to the drive, and turn {_FREE_TURNS:g} turns "
            f"each way at {_RPM:g} r/min; any key stops it"
        )

    def move(self, session: Session, outcome: StepOutcome) -> None:
        for sign in (1.0, -1.0):
            self._push(session, outcome, sign)
        for sign in (1.0, -1.0):
            self._turn(session, outcome, sign)

    def _push(self, session: Session, outcome: StepOutcome, sign: float) -> None:
        limit_nm = session.limits.torque_nm
        with self._set(session):
            try:
                recording = self._move(session, sign, _PUSH_S)
            except LimitExceeded as error:
                raise StepFailed(
                    "the brake slips", str(error), "does it wear, or is 60FEh not its output?"
                ) from error
            if not self._outputs(session)[0] & _SET_BRAKE:
                raise StepFailed("60FEh:1 tells a released brake", "it was set by the master")
        slip_deg = math.degrees(float(recording.position.max() - recording.position.min()))
        reached = float((sign * recording.torque).max())
        way = "forwards" if sign > 0 else "backwards"
        outcome.say(f"pushed {way} with {reached:.4g} N m, the shaft turned by {slip_deg:.2f} degrees")
        outcome.measured(f"slip {way}", slip_deg, "deg")
        if slip_deg > self._slip_deg:
            raise StepFailed(
                f"the brake slips: {slip_deg:.2f} degrees at {reached:.4g} N m",
                f"{self._slip_deg:g} degrees are allowed",
                "does it wear, or is 60FEh not its output?",
            )
        if not reached >= _REACHED * limit_nm:
            raise StepFailed(
                f"the drive pushed with {reached:.4g} of {limit_nm:.4g} N m",
                outcome.lines[-1],
                "its speed loop is too slow for a proof; give a lower --torque-percent",
            )

    def _turn(self, session: Session, outcome: StepOutcome, sign: float) -> None:
        recording = self._move(session, sign, math.tau * _FREE_TURNS / session.limits.speed_rad_s)
        turned = float(recording.position[-1] - recording.position[0]) / math.tau
        outcome.say(f"released by the drive, the shaft turned by {turned:+.4f} turns")
        if sign * turned < 0.5 * _FREE_TURNS:
            raise StepFailed(
                f"the brake sticks: the shaft turned by {turned:+.4f} of {sign * _FREE_TURNS:+g} turns",
                f"with {float(abs(recording.torque).max()):.4g} N m at most",
                "has the brake its voltage?",
            )

    def _move(self, session: Session, sign: float, seconds: float) -> Recording:
        """Enable, ask for a speed for ``seconds`` and for rest, and disable. A shaft that turns far is no
        reason to raise here: it is at rest again, and the caller judges its path."""
        limits = session.limits
        bounded = replace(limits, power_w=math.inf, energy_j=math.inf)
        ramps: list[Segment] = [Ramp(0.0, sign * limits.speed_rad_s, 0.1), Ramp(seconds, 0.0, 0.1)]
        with session.exercising(bounded) as exerciser:
            return exerciser.run_speeds(seconds + 0.3, ramps)

    @contextmanager
    def _set(self, session: Session) -> Iterator[None]:
        """Inside, the master sets the brake; afterwards, the drive disabled, all is as it was found."""
        objects = session.objects
        outputs, mask = self._outputs(session)
        objects.write(Object.DIGITAL_OUTPUTS, 1, "I", outputs | _SET_BRAKE)
        objects.write(Object.DIGITAL_OUTPUTS, 2, "I", mask | _SET_BRAKE)
        yield
        objects.write(Object.DIGITAL_OUTPUTS, 2, "I", mask)
        objects.write(Object.DIGITAL_OUTPUTS, 1, "I", outputs)

    def _outputs(self, session: Session) -> tuple[int, ...]:
        """Return 60FEh:1 and :2; empty if the drive lacks one."""
        told = [session.objects.read_if_there(Object.DIGITAL_OUTPUTS, sub) for sub in (1, 2)]
        return () if None in told else tuple(each for each in told if each is not None)


def brake_steps(slip_deg: float) -> list[Step]:
    """Return the steps of ``hil brake --test``."""
    return [*set_up_steps(BrakeUnits()), BrakeTest(slip_deg)]
