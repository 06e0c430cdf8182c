"""Steps that find the shaft's direction, and check the drive's units."""

import math
from dataclasses import replace
from typing import Final

import numpy as np

from servobench.drivers.cia402.drive_setup import write_optional
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.cia402.unit_factors import likely_slip
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.commissioning.excitation import Pulse
from servobench.hil.commissioning.exercise import Exerciser, Recording
from servobench.hil.commissioning.findings import StepFailed, StepOutcome, refuse_losses
from servobench.hil.commissioning.identify import SpeedRatio, plain_ratio, ratio_of
from servobench.hil.commissioning.nameplate import nameplate_wins
from servobench.hil.commissioning.ramps import ramps_told, steepen
from servobench.hil.commissioning.second_encoder import compare_encoders, has_second_encoder
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_mechanics import identified
from servobench.hil.commissioning.turn import can_home, hand_turn, index_turn
from servobench.hil.loop.scenario import Quantity, Ramp, Segment

POSITION_BIT: Final = 0x80
VELOCITY_BIT: Final = 0x40
"""Bit of 607Eh, like the one above: set, it reverses the sign."""
_NEAR_TURNS: Final = 0.003
"""A degree: by then a shaft has broken away, and is not only twisted or taking up its play."""
_NEAR_UNITS: Final = 4
"""The same for a coarse encoder, whose reading may flicker by a unit or two at rest."""
_PULSE_TURNS: Final = 0.05
"""Enough to see a direction; the shaft may be coupled."""
_LONG_PULSE_TURNS: Final = 0.25
"""Enough to compare velocity and path to a percent."""
_NUDGES: Final = 4
"""Each three times as fast as the one before, 27 times in the end: velocity units are wrong by as much."""
_PULSE_S: Final = 5.5
"""Added to the rise of the torque: for the shaft to come to a stop."""
_RATED_S: Final = 1.0
"""Time in which the torque of a pulse rises by the rated one: slowly, as the load is still unknown."""
_RISE_SHARE: Final = 0.25
"""Share of the steepest torque: a pulse falls four times as fast as it rises."""
_SIGN_ERROR: Final = 0.5
"""Relative error of a ratio that only has to show a sign."""
_RATIO_ERROR: Final = 0.01
"""Relative error of a ratio that has to show a factor."""
_RATIO_ERROR_MAX: Final = 0.1
"""Twice this separates the nearest two factors that occur, 1.25 apart."""
_UNITS_MIN: Final = 10.0
"""A velocity that shows fewer units cannot be known to 10 % by any motion, however quiet it is."""
_LOOKS: Final = 4
"""Each over a longer path, as far as the limits allow one."""
_FARTHER: Final = 4.0
"""Each look leads so many times as far as the one before."""
_WORTH_IT: Final = 1.5
"""A path that is not half as long again brings no visibly better ratio."""
_PULSE_SPEED_SHARE: Final = 0.5
"""Share of the speed limit that a longer pulse may reach: its speed goes with the root of its path."""
_RATIO_TOLERANCE: Final = 0.03
"""Slips of units are factors of 1.25 and more; smaller deviations are the measurement's."""
_ROUGH_WINDOW_S: Final = 0.03
"""A pulse is short; the fit needs several windows in it."""
_ROUGH_PERIODS: Final = 15
"""At a long period: more than the twelve samples without which a window gives no equation."""


class Polarity(Step):
    """Moves by a pulse each way, to see which way position and velocity count."""

    name = "polarity"
    title = "Direction and polarity"
    limit = "the shaft does not turn, or turns the same way for both signs"
    needs = ("enable",)
    moves = True
    essential = True

    def plan(self, session: Session, /) -> str:
        limits = session.limits
        if session.torque_mode() is None:
            return f"turn a few hundredths of a turn each way at up to {0.05 * limits.speed_rad_s:.3g} rad/s"
        return (
            f"raise the torque slowly, up to {limits.torque_nm:.4g} N m, until the shaft turns "
            f"{_PULSE_TURNS:g} turns, the same backwards; then put 607Eh right"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        position, against = _signs(session, outcome)
        velocity = position * against
        outcome.figures = {"position_sign": position, "velocity_sign": velocity}
        if position > 0 and velocity > 0:
            outcome.say("positive set-points turn the shaft towards positive positions, at positive velocity")
            return
        wrong = (POSITION_BIT if position < 0 else 0) | (VELOCITY_BIT if velocity < 0 else 0)
        outcome.faults.append(
            f"polarity: a positive set-point turns the position {'up' if position > 0 else 'down'} "
            f"and shows {'positive' if velocity > 0 else 'negative'} velocity"
        )
        if self._by_object(session, wrong, outcome):
            return
        session.overridden(torque_sign=float(position), velocity_sign=float(against))
        session.configure()
        outcome.say("607Eh does not help; the bench turns the signs itself")

    def _by_object(self, session: Session, wrong: int, outcome: StepOutcome) -> bool:
        """Reverse bits of 607Eh, and check whether that helped; else restore the object."""
        held = session.objects.read_if_there(Object.POLARITY, 0, "B")
        if held is None:
            return False
        turned = held ^ wrong
        if write_optional(session.objects, Object.POLARITY, "B", turned, "polarity"):
            return False
        session.configure()
        if _signs(session, StepOutcome()) == (1, 1):
            outcome.faults[-1] += f"; 607Eh was {held:02X}h and is {turned:02X}h now"
            outcome.figures["polarity"] = turned
            return True
        session.objects.write(Object.POLARITY, 0, "B", held)
        return False


def _signs(session: Session, outcome: StepOutcome) -> tuple[int, int]:
    """Return the sign of the position against the set-point, and of the velocity against the position."""
    recordings, ratio = _compared(session, _PULSE_TURNS, _SIGN_ERROR)
    signs = []
    for direction, recording in zip((1.0, -1.0), recordings, strict=True):
        moved = float(recording.position[-1] - recording.position[0])
        outcome.say(f"set-point {'+' if direction > 0 else '-'}: {moved / math.tau:+.4f} turns")
        signs.append(math.copysign(1.0, moved * direction))
    if signs[0] != signs[1]:
        raise StepFailed("the shaft turns the same way for both signs", "; ".join(outcome.lines))
    if math.isnan(ratio.value) or ratio.value == 0.0:
        raise StepFailed("the velocity 606Ch stays at 0 while the position changes")
    return int(signs[0]), int(math.copysign(1.0, ratio.value))


def _compared(session: Session, turns: float, error: float) -> tuple[list[Recording], SpeedRatio]:
    """Return pulses, and velocity over path: known to ``error``, or as well as paths within the limits allow.

    The integral of a velocity that scatters grows with the square root of the time, the path with its square.
    """
    limits = session.limits
    for _ in range(_LOOKS):
        recordings = pulses(session, turns)
        ratio = ratio_of([(each.time, each.velocity, each.position) for each in recordings])
        fastest = max(float(np.max(np.abs(each.speed))) for each in recordings)
        longer = min(_FARTHER, (_PULSE_SPEED_SHARE * limits.speed_rad_s / max(fastest, 1e-9)) ** 2)
        if ratio.error <= error or longer < _WORTH_IT:
            break
        turns *= longer
    return recordings, ratio


def pulses(session: Session, far_turns: float, ways: tuple[float, ...] = (1.0, -1.0)) -> list[Recording]:
    """Make a pulse each way, each from rest to rest. Raises StepFailed if nothing moves."""
    far = min(far_turns * math.tau, 0.4 * session.limits.travel_rad)
    near = max(_NEAR_TURNS * math.tau, _NEAR_UNITS * session.position_rad)
    recordings = _both_ways(session, near, far, ways)
    paths = [abs(float(each.position[-1] - each.position[0])) for each in recordings]
    if session.torque_mode() is None and min(paths) < 0.5 * far and steepen(session.found):
        session.configure()
        recordings = _both_ways(session, near, far, ways)
        paths = [abs(float(each.position[-1] - each.position[0])) for each in recordings]
    if session.torque_mode() is None and min(paths) < near:
        ramps = ramps_told(session.found)
        raise StepFailed(
            f"the shaft does not turn at {0.5 * session.limits.speed_rad_s:.3g} rad/s and below",
            f"{min(paths) / math.tau:.5f} turns{f'; {ramps}' if ramps else ''}",
            "a brake, or a blocked shaft? limits.torque_max_percent in the nameplate allows more",
        )
    return recordings


def _both_ways(session: Session, near: float, far: float, ways: tuple[float, ...]) -> list[Recording]:
    limits = session.limits
    rise = min(session.rated_torque_nm / _RATED_S, _RISE_SHARE * limits.torque_slew_nm_s)
    recordings = []
    with session.exercising() as exerciser:
        for direction in ways:
            if exerciser.port.quantity is not Quantity.TORQUE:
                recordings.append(_nudges(exerciser, direction, far))
                refuse_losses(recordings[-1].lost, recordings[-1].cycles)
                continue
            pulse = Pulse(direction * limits.torque_nm, rise, near, max(far, 2.0 * near), exerciser.period_s)
            longest_s = _PULSE_S + limits.torque_nm / rise
            recording = exerciser.run(pulse, longest_s, done=pulse.done, guard_speed=False)
            refuse_losses(recording.lost, recording.cycles)
            if not pulse.moved:
                raise StepFailed(
                    f"the shaft does not turn with {limits.torque_nm:.4g} N m",
                    f"{abs(recording.position[-1] - recording.position[0]) / math.tau:.5f} turns",
                    "a brake, or a blocked shaft? limits.torque_max_percent in the nameplate allows more",
                )
            recordings.append(recording)
    return recordings


def _nudges(exerciser: Exerciser, direction: float, far: float) -> Recording:
    """Make short runs at a low speed until one leads far enough, for a drive that takes speeds."""
    speed = min(0.02 * exerciser.limits.speed_rad_s, far / 0.5)
    for _ in range(_NUDGES):
        recording = _nudge(exerciser, direction * speed, far)
        if abs(recording.position[-1] - recording.position[0]) >= 0.5 * far:
            break
        # The unit of the speed may be another than the drive tells.
        speed = min(3.0 * speed, 0.5 * exerciser.limits.speed_rad_s)
    return recording


def _nudge(exerciser: Exerciser, speed: float, far: float) -> Recording:
    over = max(0.1, abs(speed) / exerciser.limits.acceleration_rad_s2)
    hold = max(0.3, abs(far / speed))
    reference: list[Segment] = [Ramp(0.0, speed, over), Ramp(over + hold, 0.0, over)]
    return exerciser.run_speeds(hold + 2.0 * over + 0.3, reference, guard_speed=False)


class MotionUnits(Step):
    """Compares the velocity with the derivative of the position; estimates inertia and friction roughly."""

    name = "motion_units"
    title = "Velocity against position"
    limit = "the velocity does not follow the position, or scatters by more than 10 % of it"
    needs = ("polarity",)
    moves = True
    essential = True

    def plan(self, _session: Session, /) -> str:
        return f"turn {_LONG_PULSE_TURNS:g} turns each way and compare the velocity with the path"

    def run(self, session: Session, outcome: StepOutcome) -> None:
        findings = session.found
        recordings, measured = _compared(session, _LONG_PULSE_TURNS, _RATIO_ERROR)
        told = session.told
        used = session.velocity_rad_s / told.velocity_rad_s
        findings.velocity_ratio = SpeedRatio(abs(measured.value) / used, measured.error)
        ratio, percent = findings.velocity_ratio.value, 100.0 * measured.error
        outcome.figures = {"velocity_over_path": ratio, "velocity_over_path_error": measured.error}
        outcome.say(
            f"velocity 606Ch is {ratio:.4g} of the slope of the position 6064h +- {percent:.2g} % (k = 2)"
        )
        units = max(float(np.max(np.abs(each.velocity))) for each in recordings) / session.velocity_rad_s
        if not measured.error <= _RATIO_ERROR_MAX and units < _UNITS_MIN:
            raise StepFailed(
                "the velocity 606Ch is too coarse for its unit to be told from this motion",
                f"it shows {units:.0f} units at most, of {session.velocity_rad_s:.4g} rad/s "
                f"({session.units.sources.get('velocity', 'told')})",
                "see that this unit is right; allow more speed and travel ([limits] of the nameplate)",
            )
        if not measured.error <= _RATIO_ERROR_MAX:
            raise StepFailed(
                "the velocity 606Ch scatters too much for its unit to be told from this motion",
                f"{percent:.2g} % (k = 2); {100.0 * _RATIO_ERROR_MAX:g} % is borne",
                "allow more speed and travel ([limits] of the nameplate), or smooth 606Ch in the drive",
            )
        if abs(ratio - 1.0) > _tolerance(findings.velocity_ratio):
            factor = plain_ratio(ratio, _tolerance(findings.velocity_ratio))
            outcome.faults.append(
                f"velocity and position units contradict each other by {factor:.6g}; "
                "unless a turn was measured below, the velocity's is taken for the wrong one"
            )
            session.overridden(velocity_rad_s=told.velocity_rad_s / factor)
            session.configure()
        if has_second_encoder(session):
            compare_encoders(session, outcome, lambda way: pulses(session, _LONG_PULSE_TURNS, (way,)))
        if session.torque_mode() is not None:
            self._rough(session, recordings, outcome)

    def _rough(self, session: Session, recordings: list[Recording], outcome: StepOutcome) -> None:
        window_s = max(_ROUGH_WINDOW_S, _ROUGH_PERIODS * session.found.period / NS_PER_S)
        failure = "the pulses tell nothing of the inertia"
        rough = identified(session, recordings, window_s, failure, with_viscous=False, with_offset=False)
        session.found.rough = rough
        if rough.inertia_kg_m2 <= 0.0:
            raise StepFailed("the pulses give no positive inertia", f"{rough.inertia_kg_m2:.3g} kg m^2")
        outcome.say(
            f"for a start: inertia {rough.inertia_kg_m2:.3g} kg m^2, "
            f"friction {rough.coulomb_friction_nm:.3g} N m"
        )


class Turn(Step):
    """Measures one real turn of the motor in the drive's position units."""

    name = "turn"
    title = "Encoder counts by a turn"
    limit = "no turn can be measured and nothing else tells it"
    needs = ("motion_units",)
    moves = True

    def left_out(self, session: Session) -> str | None:
        travel = session.limits.travel_rad
        if travel < 3.0 * math.tau:
            return f"only {travel / math.tau:g} turns are allowed"
        known = session.request.nameplate.encoder.counts_per_revolution is not None
        if not (known or session.dialog.attended or can_home(session)):
            return "no homing, nobody there to turn the shaft, and no nameplate that tells the encoder"
        return None

    def plan(self, _session: Session, /) -> str:
        return (
            "look for two index pulses in a row by homing (method 34) at low speed, "
            "or have the shaft turned by hand; compare with the position unit"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        told = session.told
        units, how = index_turn(session)
        session.configure()  # back from homing, also where the step fails: the next one commands a motion
        if units is None and session.dialog.attended:
            units, how = hand_turn(session)
        counts = session.request.nameplate.encoder.counts_per_revolution
        believed = math.tau / told.position_rad
        if units is None and counts is None:
            raise StepFailed(
                "no turn could be measured", how, "give encoder.counts_per_revolution in the nameplate"
            )
        if units is None:
            assert counts is not None
            units, how = _unmeasured(session, counts, believed, outcome)
        ratio = units / believed
        outcome.figures = {"units_per_turn": units, "told_units_per_turn": believed}
        outcome.say(
            f"one turn is {_count(units)} position units ({how}); the drive's objects say {_count(believed)}"
        )
        self._judge(session, ratio, outcome)
        session.configure()

    def _judge(self, session: Session, ratio: float, outcome: StepOutcome) -> None:
        """Correct position by the turn, and velocity by the position."""
        findings = session.found
        told = session.told
        assert findings.velocity_ratio is not None
        position = told.position_rad
        if abs(ratio - 1.0) > _RATIO_TOLERANCE:
            ratio = plain_ratio(ratio)
            position /= ratio
            outcome.faults.append(
                f"position unit: {told.sources.get('position')} makes {told.position_rad:.6g} rad of it, "
                f"it is {position:.6g} rad; that is taken{_because(ratio, told)}"
            )
            outcome.figures["position_fault"] = ratio
        # What the velocity unit is by the true position.
        factor = position / told.position_rad / findings.velocity_ratio.value
        if abs(factor - 1.0) > _tolerance(findings.velocity_ratio):
            factor = plain_ratio(factor, _tolerance(findings.velocity_ratio))
            velocity = told.velocity_rad_s * factor
            outcome.faults.append(
                f"velocity unit: {told.sources.get('velocity')} makes {told.velocity_rad_s:.6g} rad/s of it, "
                f"it is {velocity:.6g} rad/s; that is taken{_because(factor, told)}"
            )
            outcome.figures["velocity_fault"] = factor
        else:
            velocity = told.velocity_rad_s
        session.overridden(position_rad=position, velocity_rad_s=velocity)
        outcome.figures |= {"position_rad": position, "velocity_rad_s": velocity}
        if findings.rough is not None:  # by the old position unit
            inertia = findings.rough.inertia_kg_m2 / (position / told.position_rad)
            findings.rough = replace(findings.rough, inertia_kg_m2=inertia)


def _tolerance(ratio: SpeedRatio) -> float:
    """Return the deviation allowed from a known factor: twice its uncertainty, as no other is near."""
    return max(_RATIO_TOLERANCE, 2.0 * ratio.error)


def _unmeasured(session: Session, counts: int, believed: float, outcome: StepOutcome) -> tuple[float, str]:
    """Return the position units of a turn if none could be turned, and their source."""
    plate, drive = f"{counts} counts per turn", f"{_count(believed)} position units"
    if abs(counts / believed - 1.0) > _RATIO_TOLERANCE and not nameplate_wins(
        session, "encoder", plate, drive
    ):
        outcome.faults.append(f"nameplate: {plate} are not believed, the drive's objects say {drive}")
        return believed, "not measured; the drive's objects are believed"
    return float(counts), "the nameplate's encoder, whose counts are taken for position units"


def _because(factor: float, told: Scaling) -> str:
    slip = likely_slip(factor, gear_ratio=told.gear_ratio)
    return f" (a factor of {factor:.6g}: {slip or 'no usual one'})"


def _count(units: float) -> str:
    """Position units of a turn, which are whole where they are many."""
    return f"{units:.0f}" if units >= 1000 else f"{units:.6g}"
