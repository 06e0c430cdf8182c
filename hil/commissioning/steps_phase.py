"""The step of ``hil phase``: pole pairs, order of the lines and commutation offset, by a field that turns.

The drive's mode "cyclic synchronous torque with commutation angle" takes the electrical angle from 60EAh. A
positive torque then is a current that leads it by a quarter of a turn, and the rotor settles there:

    rotor = 60EAh + 90 degrees = sign x pole pairs x shaft + constant

The field is turned by one electrical turn and back. The mean of both ways is free of friction; their
difference is twice its lag. What the drive takes for the rotor's angle is compared with that mean.

While nobody knows the rotor's angle, no ramp can be trusted: every way out takes the torque away, and the
shaft, which creeps at a turn in some seconds, coasts.
"""

import math
from typing import Final

import numpy as np

from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.canopen.write_list import WriteList
from servobench.drivers.cia402.drive_setup import write_optional
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import (
    AbortConnectionOption,
    DisableOperationOption,
    FaultReactionOption,
    Mode,
    QuickStopOption,
    ShutdownOption,
    State,
    offers_mode,
    state_of,
)
from servobench.drivers.errors import LimitExceeded
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.drivers.vendors.commutation_objects import CommutationObject, CommutationObjects
from servobench.drivers.vendors.families import commutation_for
from servobench.hil.commissioning.alignment import Alignment, Sweep, judged
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE
from servobench.hil.commissioning.exercise import OVERSPEED
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.request import PlateLimits
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_manual import ManualStep, SpeedUnits, set_up_steps
from servobench.hil.commissioning.steps_units import POSITION_BIT, pulses
from servobench.hil.restoring.journal import ObjectKey
from servobench.hil.write_lists import makers_commutation

_ANGLE_MODE: Final = Mode.CYCLIC_SYNCHRONOUS_TORQUE_WITH_ANGLE
_RPM: Final = 200.0
"""A rotor that snaps into a field half a turn away, with ten times its own inertia behind it, is slower."""
_STEP: Final = Duration(NS_PER_S // 50)
_RISE_S: Final = 1.0
"""The field grows so slowly that the rotor turns into it rather than to jump."""
_LOOKS: Final = 2
"""At the rotor between two steps of the torque, each of which the journal notes."""
_SETTLE_S: Final = 0.5
_TURN_S: Final = 1.5
"""For an electrical turn: far below the frequency at which a rotor swings in its field."""
_RUN_IN: Final = 0.25
"""Of an electrical turn: behind it friction drags the rotor evenly."""
_NEAR_DEG: Final = 3.0
"""Offsets that differ by less are one: it costs 0.14 % of the torque, and cogging makes as much."""
_PULSE_TURNS: Final = 0.05
_OFF: Final = (
    (Object.ABORT_CONNECTION_OPTION, AbortConnectionOption.DISABLE_VOLTAGE),
    (Object.QUICK_STOP_OPTION, QuickStopOption.DISABLE),
    (Object.SHUTDOWN_OPTION, ShutdownOption.DISABLE),
    (Object.DISABLE_OPERATION_OPTION, DisableOperationOption.DISABLE),
    (Object.FAULT_REACTION_OPTION, FaultReactionOption.DISABLE),
)
"""Reactions that take the torque away."""


def phase_limits(torque_percent: float, turns: float) -> PlateLimits:
    """Return the limits of the alignment."""
    return PlateLimits(speed_max_rpm=_RPM, torque_max_percent=torque_percent, turns_max=turns)


class FieldUnits(SpeedUnits):
    """Any mode will do for the set-up; the field is turned in a mode of its own."""

    modes = tuple(QUANTITY_OF_MODE)


class Phase(ManualStep):
    """Turns the field, and sets and proves what the drive has to know of its motor."""

    name = "phase"
    title = "Commutation"
    limit = "the rotor does not follow the field, or the drive's angle does not follow the rotor"

    def __init__(self, apply: bool) -> None:
        """``apply``: what is found stays in the drive."""
        self._apply = apply

    def lack(self, session: Session) -> str:
        modes = session.objects.read_if_there(Object.SUPPORTED_DRIVE_MODES)
        if modes is None or not offers_mode(modes, _ANGLE_MODE):
            number = int(_ANGLE_MODE)
            return (
                f"not for this maker: the drive has no mode {number} (bit {number - 1} of 6502h), in which a "
                "master turns the field; use the maker's tool"
            )
        missing = session.objects.read_if_there(Object.COMMUTATION_ANGLE, 0, "H") is None
        return "the drive has no commutation angle (60EAh)" if missing else ""

    def plan(self, session: Session, /) -> str:
        limits, known = session.limits, _known(session)
        settings = known.settings if known.angle is not None else ()
        names = ", ".join(object_name(each.index, each.sub) for each in settings)
        keeps = "write nothing of it, as no public document names this maker's objects"
        if names:
            keeps = (
                f"write what is found into {names}, turn the shaft by {_PULSE_TURNS:g} turns each way by the "
                "drive's own angle (a light shaft runs on), and "
                f"{'keep' if self._apply else 'put back'} what was written"
            )
        return (
            f"turn the field by {1.0 + _RUN_IN:g} electrical turns and back with {limits.torque_nm:.4g} N m, "
            "up to three times: with p pole pairs the shaft turns up to "
            f"{1.5 + _RUN_IN:g}/p turns; then {keeps}; "
            "while the field is on, every stop takes the torque away; it is stopped by any key, at "
            f"{OVERSPEED * limits.speed_rad_s / RAD_S_PER_RPM:.4g} r/min, and "
            f"{limits.travel_rad / math.tau:.4g} turns from here"
        )

    def move(self, session: Session, outcome: StepOutcome) -> None:
        known = _known(session)
        product = session.network.writes.products[session.request.node]
        session.network.writes.allowed |= WriteList("commutation", makers_commutation(product))
        found = self._aligned(session, known)
        _tell(outcome, found)
        if known.angle is None:
            outcome.say("no public document names this maker's objects for it: nothing was written")
            return
        if self._set(session, known, found, outcome):
            found = self._aligned(session, known)
        ahead_deg = found.ahead_deg
        assert ahead_deg is not None, "the drive tells its angle"
        outcome.say(f"the drive's angle is {ahead_deg:+.1f} electrical degrees beyond the rotor's")
        outcome.measured("commutation error", ahead_deg, "deg")
        if known.offset is not None and abs(ahead_deg) > _NEAR_DEG:
            offset = known.offset
            held = _held(session, offset)
            raw = held - round(ahead_deg / 360.0 * offset.turn)
            self._write(session, offset, raw, outcome)
            ahead_deg = self._aligned(session, known).ahead_deg or 0.0
            outcome.say(f"with that it is {ahead_deg:+.1f} degrees")
        outcome.figures["ahead_deg"] = ahead_deg
        if abs(ahead_deg) > _NEAR_DEG:
            raise StepFailed(
                f"the drive's angle is {ahead_deg:+.1f} electrical degrees beyond the rotor's",
                "; ".join(outcome.lines),
                "is the encoder fixed to the shaft?",
            )
        self._prove(session, outcome)
        if self._apply:
            keys = [ObjectKey(each.index, each.sub) for each in known.settings]
            session.kept = {key for key in keys if key in session.network.taken[session.request.node]}

    def _set(
        self, session: Session, known: CommutationObjects, found: Alignment, outcome: StepOutcome
    ) -> bool:
        """Write pole pairs and order of the lines where they differ; return True if one did."""
        changed = False
        pairs, swapped = known.pole_pairs, known.swapped
        if pairs is not None and (held := _held(session, pairs)) != found.pole_pairs:
            outcome.faults.append(f"{held} pole pairs are set, the motor has {found.pole_pairs}")
            self._write(session, pairs, found.pole_pairs, outcome)
            changed = True
        if not found.rises:
            outcome.faults.append("two of the motor's lines are swapped, for what the drive is set to")
            if swapped is None:
                raise StepFailed(
                    outcome.faults[-1], "no object turns their order round", "swap two of the motor's lines"
                )
            self._write(session, swapped, 1 - _held(session, swapped), outcome)
            changed = True
        return changed

    def _write(self, session: Session, known: CommutationObject, raw: int, outcome: StepOutcome) -> None:
        name, node = object_name(known.index, known.sub), session.request.node
        before, data = _held(session, known), known.data(raw)
        session.network.download(node, known.index, known.sub, data)
        if (held := _held(session, known)) != known.raw(data):
            raise StepFailed(f"{name} holds {held}", f"{known.raw(data)} was written")
        outcome.say(f"{name} was {before}, and is {held}")

    def _prove(self, session: Session, outcome: StepOutcome) -> None:
        """Have the drive turn the shaft by its own angle, both ways."""
        session.configure()
        turned = [
            float(each.position[-1] - each.position[0]) / math.tau for each in pulses(session, _PULSE_TURNS)
        ]
        outcome.say(
            f"by its own angle, the drive turned the shaft by {turned[0]:+.4f} and {turned[1]:+.4f} turns"
        )
        polarity = session.objects.read_if_there(Object.POLARITY, 0, "B") or 0
        up = -1.0 if polarity & POSITION_BIT else 1.0
        if not turned[0] * up > 0.0 > turned[1] * up:
            raise StepFailed("a positive torque does not turn the shaft up", outcome.lines[-1])

    # ---- the field -------------------------------------------------------------------------------------

    def _aligned(self, session: Session, known: CommutationObjects) -> Alignment:
        """Turn the field there and back. Raises StepFailed for a rotor that does not follow."""
        drive = session.drive
        for index, option in _OFF:
            write_optional(session.objects, index, "h", int(option), "torque off")
        drive.change_mode(_ANGLE_MODE, session.deadline(1.0))
        limit = session.limits.torque_nm / drive.assembler.scaling.torque_nm
        with session.enabled():
            begun = _Field(session, known.angle)
            begun.grow(math.floor(limit))
            there = begun.turn(1.0)
            back = begun.turn(-1.0)
            drive.control.write_value(Object.TARGET_TORQUE, "h", 0)
        polarity = session.objects.read_if_there(Object.POLARITY, 0, "B") or 0
        return judged(there, back, -1.0 if polarity & POSITION_BIT else 1.0)


class _Field:
    """The field while it is on: each step of it is written, and the rotor looked at."""

    def __init__(self, session: Session, angle: CommutationObject | None) -> None:
        self._session, self._angle = session, angle
        self._field = 0.0
        """Electrical turns."""
        self._began: float | None = None
        self._last = 0.0
        self._due = session.clock_now

    def grow(self, torque: int) -> None:
        """Raise the torque, thousandths, and let the rotor settle."""
        steps = round(_RISE_S * NS_PER_S / _STEP / _LOOKS)
        self._order(0.0)
        for step in range(1, steps + 1):
            self._session.drive.control.write_value(Object.TARGET_TORQUE, "h", torque * step // steps)
            for _ in range(_LOOKS):
                self._look()
        for _ in range(round(_SETTLE_S * NS_PER_S / _STEP)):
            self._look()

    def turn(self, way: float) -> Sweep:
        """Turn the field, and return what is seen behind the run-in."""
        steps = round(_TURN_S * NS_PER_S / _STEP)
        run_in = round(_RUN_IN * steps)
        seen = []
        for step in range(run_in + steps):
            self._order(self._field + way / steps)
            shaft = self._look()
            if step >= run_in:
                seen.append((math.tau * self._field, shaft, self._told()))
        return Sweep(*np.array(seen).T)

    def _order(self, turns: float) -> None:
        self._field = turns
        self._session.objects.write(Object.COMMUTATION_ANGLE, 0, "H", round(turns * 65536) % 65536)

    def _look(self) -> float:
        """Let a step pass, and return the shaft's place, rad. Raises as the limits and the drive say."""
        session = self._session
        self._due = Instant(max(self._due + _STEP, session.clock_now))
        session.network.pump(self._due)
        session.check_stop()
        control = session.drive.control
        if state_of(control.read_status()) is not State.OPERATION_ENABLED:
            raise control.in_fault() if control.read_state() is State.FAULT else control.stuck("stay enabled")
        place = session.objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i") * session.position_rad
        if self._began is None:
            self._began = self._last = place
        limits = session.limits
        speed, self._last = abs(place - self._last) * NS_PER_S / _STEP, place
        if speed > OVERSPEED * limits.speed_rad_s:
            raise LimitExceeded(f"the shaft turns at {speed / RAD_S_PER_RPM:.0f} r/min")
        if abs(place - self._began) > limits.travel_rad:
            raise LimitExceeded(f"the shaft turned by {limits.travel_rad / math.tau:g} turns")
        return place

    def _told(self) -> float:
        if self._angle is None:
            return math.nan
        return math.tau * _held(self._session, self._angle) / self._angle.turn


def _known(session: Session) -> CommutationObjects:
    """Return the maker's objects that this drive has."""
    identity = session.drive.identity
    assert identity is not None, "the step 'identity' comes first"
    known = commutation_for(identity.vendor, identity.product, identity.device_name)
    if known is None:
        return CommutationObjects(source="none")

    def there(each: CommutationObject | None) -> CommutationObject | None:
        has = each is not None and session.objects.read_if_there(each.index, each.sub, "B") is not None
        return each if has else None

    return CommutationObjects(
        source=known.source,
        offset=there(known.offset),
        angle=there(known.angle),
        swapped=there(known.swapped),
        pole_pairs=there(known.pole_pairs),
    )


def _held(session: Session, known: CommutationObject) -> int:
    return known.raw(session.network.upload(session.request.node, known.index, known.sub))


def _tell(outcome: StepOutcome, found: Alignment) -> None:
    order = "rises" if found.rises else "falls"
    outcome.say(
        f"{found.pole_pairs} pole pairs; the rotor's electrical angle {order} with the encoder's; friction "
        f"holds it back by {abs(found.lag_deg):.1f} electrical degrees"
    )
    outcome.figures = {
        "pole_pairs": found.pole_pairs, "rises": found.rises, "lag_deg": found.lag_deg,
        "ahead_deg": found.ahead_deg,
    }  # fmt: skip


def phase_steps(apply: bool) -> list[Step]:
    """Return the steps of ``hil phase``."""
    return [*set_up_steps(FieldUnits()), Phase(apply)]
