"""The step that compares the back-EMF with the DC link: the voltage constant, or its upper bound.

A drive can put sqrt(v_d^2 + v_q^2) <= U_dc / sqrt(3) into each phase (space-vector modulation). Where a shaft
is pushed on by a torque well above its friction and turns no faster, its back-EMF takes all of that:

    U_dc / sqrt(3) = K_e omega + R i        K_e = n_p phi, V s/rad, phase, peak

The torque constant rests on 6076h and 6075h, K_e does not: 3/2 sqrt(2) K_e is N m per A rms, so each checks
the other. Where the limit of speed comes first, K_e is below U_dc / (sqrt(3) omega).
"""

import itertools
import math
from typing import Final

import numpy as np

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.unit_factors import TORQUE_SLIPS, likely_slip
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import StepFailed, StepOutcome, refuse_losses
from servobench.hil.commissioning.nameplate import CONSTANT_QUANTITY
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.torque_scale import TORQUE_PER_VOLTAGE
from servobench.hil.loop.protocol import Context, Controller, SetPoint, TorqueSetPoint
from servobench.hil.loop.samples import StateEstimate

_SPEED_SHARE: Final = 0.95
"""Share of the speed limit."""
_PUSH_SHARE: Final = 0.3
"""Share of the torque limit, in addition to friction: a run-up of a second or two."""
_RISE_SHARE: Final = 0.2
"""Share of the steepest torque, with which the push rises."""
_LOOK_S: Final = 0.15
"""Interval between two checks of the speed: long enough to show whether the shaft still accelerates."""
_END_S: Final = 0.02
"""End part of a run-up that reaches the speed limit."""
_STALLED: Final = 0.1
"""Share of the acceleration by the push on a shaft whose torque is not limited."""
_VOLTAGE_V: Final = (5.0, 1500.0)
"""Possible DC links for motors; 6079h is in mV, and some drives use other units."""
_PLATE_RATIO: Final = 1.5
"""DC link and losses are known to a tenth or two; 1.73, lines taken for phases, is beyond it."""
_USED: Final = 0.05
"""k = 2, relative: the DC link lost to dead times and to the room for current measurement."""
_DROP: Final = 0.08
"""R i over the phase voltage at the rated current, at most, for a servo motor with unknown R."""
_CONTRADICTION: Final = 1.5
"""Sines without third harmonic use 0.866 of the DC link, and ratings are rounded."""
_DOUBT: Final = 1.25
"""From here on it is a finding, and the step continues: sqrt(2) is more, sines without third harmonic
less."""


class VoltageConstant(Step):
    """Runs up towards the speed limit, to see whether the DC link limits the speed before."""

    name = "voltage_constant"
    title = "Voltage constant against the DC link"
    limit = "torque constant and DC link contradict each other by more than 1.5"
    needs = ("mechanics",)
    moves = True

    def left_out(self, session: Session) -> str | None:
        if session.torque_mode() is None:
            return "the drive has no torque mode"
        if not session.objects.read_if_there(Object.DC_LINK_CIRCUIT_VOLTAGE):
            return "the drive tells no DC link voltage 6079h: its voltage constant cannot be measured"
        known = session.found.mechanics is not None
        if known and session.limits.travel_rad < 1.5 * _path_rad(session):
            return f"the run-up takes {_path_rad(session) / math.tau:.1f} turns, more than is allowed"
        return None

    def plan(self, session: Session, /) -> str:
        speed = _SPEED_SHARE * session.limits.speed_rad_s / RAD_S_PER_RPM
        known = session.found.mechanics is not None
        push = f" with {_push_nm(session):.3g} N m" if known else ""
        return f"push the shaft up to {speed:.0f} r/min{push}; read 6079h"

    def run(self, session: Session, outcome: StepOutcome) -> None:
        dc_v = dc_link_v(session)
        push_nm = _push_nm(session)
        rise_nm_s = _RISE_SHARE * session.limits.torque_slew_nm_s
        # Behind its end the torque falls by the drive's slope, and the speed goes on rising meanwhile.
        behind = push_nm**2 / (2.0 * session.limits.torque_slew_nm_s * session.mechanics.inertia_kg_m2)
        top = max(_SPEED_SHARE * session.limits.speed_rad_s - behind, 0.5 * session.limits.speed_rad_s)
        with session.exercising() as exerciser:
            up = RunUp(push_nm, rise_nm_s, top, exerciser.period_s, _slow(session))
            longest_s = push_nm / rise_nm_s + 3.0 * _run_up_s(session) + 4.0 * _LOOK_S
            recording = exerciser.run(up, longest_s, done=up.done)
        refuse_losses(recording.lost, recording.cycles)
        if not len(recording.time):
            raise StepFailed("no reading came")
        voltage_v = dc_v / math.sqrt(3.0)
        speed = _ending_rad_s(recording, _LOOK_S if up.stalled else _END_S)
        outcome.figures = {"dc_link_v": dc_v, "speed_rad_s": speed, "limited": up.stalled}
        outcome.say(f"6079h tells {dc_v:.4g} V: at most {voltage_v:.4g} V a phase, peak")
        expected = _by_torque(session)
        if up.stalled:
            constant = _constant(session, voltage_v, speed, outcome)
            session.found.voltage_constant = constant, outcome.figures["voltage_constant_error"]
            _judge(constant, constant, expected, outcome)
        else:
            bound = voltage_v / speed
            outcome.say(
                f"the voltage does not give out below {speed / RAD_S_PER_RPM:.0f} r/min, near the limit of "
                f"speed: the voltage constant is less than {bound:.4g} V s/rad (phase, peak)"
            )
            outcome.figures["voltage_constant_below"] = bound
            _judge(0.0, bound, expected, outcome)


class RunUp(Controller):
    """Pushes with a torque until the shaft is fast enough, or no longer accelerates for a while.

    torque    ____________________
             /                    |
    ________/                     done: at the speed, or it gains less than ``slow``
    """

    def __init__(
        self, push_nm: float, slew_nm_s: float, speed_rad_s: float, period_s: float, slow: float
    ) -> None:
        """``slow``: rad/s^2."""
        self._push_nm = push_nm
        self._step = slew_nm_s * period_s
        self._speed = speed_rad_s
        self._slow = slow
        self._torque = 0.0
        self._looks: list[StateEstimate] = []
        self._fast = False
        self.stalled = False
        """True if the push no longer accelerates the shaft."""

    def output(self, context: Context) -> SetPoint:
        """Return the torque of this cycle."""
        self._torque = min(self._push_nm, self._torque + self._step)
        estimate = context.estimate
        if estimate.sequence:
            self._fast = self._fast or abs(estimate.velocity_rad_s) >= self._speed
            self._look(estimate)
        return TorqueSetPoint(self._torque)

    def done(self) -> bool:
        """Return True once the run-up has shown everything."""
        return self._fast or self.stalled

    def _look(self, look: StateEstimate) -> None:
        looks = self._looks
        if looks and (look.valid_at - looks[-1].valid_at) < _LOOK_S * NS_PER_S:
            return
        looks.append(look)
        if len(looks) < 4 or self._torque < self._push_nm:
            return
        speeds = [
            (after.position_rad - before.position_rad) / ((after.valid_at - before.valid_at) / NS_PER_S)
            for before, after in zip(looks[-4:-1], looks[-3:], strict=True)
        ]
        self.stalled = not self._fast and all(
            abs(after - before) < self._slow * _LOOK_S for before, after in itertools.pairwise(speeds)
        )


def _push_nm(session: Session) -> float:
    friction = session.mechanics.friction_nm(session.limits.speed_rad_s)
    return min(session.limits.torque_nm, friction + _PUSH_SHARE * session.limits.torque_nm)


def _run_up_s(session: Session) -> float:
    mechanics, limits = session.mechanics, session.limits
    left = max(_push_nm(session) - mechanics.friction_nm(limits.speed_rad_s), 1e-3 * limits.torque_nm)
    return mechanics.inertia_kg_m2 * limits.speed_rad_s / left


def _slow(session: Session) -> float:
    """Return the acceleration, rad/s^2, below which it is no run-up."""
    return _STALLED * session.limits.speed_rad_s / _run_up_s(session)


def _path_rad(session: Session) -> float:
    return session.limits.speed_rad_s * (_run_up_s(session) + 4.0 * _LOOK_S)


def dc_link_v(session: Session) -> float:
    """Read the DC link voltage. Raises StepFailed for an impossible one."""
    link_v = (session.objects.read_if_there(Object.DC_LINK_CIRCUIT_VOLTAGE) or 0) / 1000.0
    printed = session.request.nameplate.rating.dc_bus_voltage_v
    low, high = _VOLTAGE_V if printed is None else (printed / _PLATE_RATIO, printed * _PLATE_RATIO)
    if not low <= link_v <= high:
        raise StepFailed(
            f"6079h tells {link_v:g} V of DC link",
            f"{'a motor needs' if printed is None else f'the nameplate says {printed:g} V; within'} "
            f"{low:.4g} to {high:.4g} V",
            "measure the DC link: 6079h is in mV, or the nameplate's dc_bus_voltage_v is wrong",
        )
    return link_v


def _ending_rad_s(recording: Recording, window_s: float) -> float:
    """Return the speed at the end of the run-up."""
    last = recording.time >= recording.time[-1] - window_s
    path, passed_s = np.ptp(recording.position[last]), np.ptp(recording.time[last])
    if not passed_s:
        raise StepFailed("too few readings came")
    if not path:
        torque_nm = float(np.mean(recording.torque[last]))
        raise StepFailed(
            "the shaft stands at the end of the run-up",
            f"against {torque_nm:.3g} N m",
            "an end stop, or a brake?",
        )
    return float(path / passed_s)


def _constant(session: Session, voltage_v: float, speed: float, outcome: StepOutcome) -> float:
    """Return V s/rad from the speed at the voltage limit."""
    torque_nm = session.mechanics.friction_nm(speed)  # at a speed that stays
    resistance, per_a = session.found.value("resistance_ohm"), session.found.torque_constant_nm_a
    drop_v, unsure_v = 0.0, _DROP * voltage_v * torque_nm / session.rated_torque_nm
    if resistance is not None and per_a is not None:
        drop_v = resistance * math.sqrt(2.0) * torque_nm / per_a
        unsure_v = 0.3 * drop_v  # copper gains 0.39 % of resistance per kelvin
    constant = (voltage_v - drop_v) / speed
    error = constant * math.hypot(_USED, unsure_v / voltage_v)
    per_krpm = constant * math.sqrt(1.5) * 1000.0 * RAD_S_PER_RPM
    outcome.measured("speed at the voltage limit", speed / RAD_S_PER_RPM, "r/min")
    outcome.measured("voltage constant, phase, peak", constant, "V s/rad", error)
    outcome.figures |= {"voltage_constant": constant, "voltage_constant_error": error}
    outcome.say(f"pushed on, the shaft turns no faster than {speed / RAD_S_PER_RPM:.0f} r/min")
    outcome.say(
        f"voltage constant {constant:.4g} V s/rad +- {error:.2g} (k = 2; phase, peak, by space-vector "
        f"modulation), {per_krpm:.4g} V per 1000 r/min between two phases, rms"
    )
    outcome.headline = outcome.lines[-1]
    return constant


def _by_torque(session: Session) -> float | None:
    """Return V s/rad by the torque constant: measured, stated, or from the ratings."""
    findings = session.found
    by_torque = findings.torque_constant_nm_a or findings.motor.value(CONSTANT_QUANTITY)
    if by_torque is None and findings.rated_current_a:
        by_torque = session.rated_torque_nm / findings.rated_current_a
    return None if by_torque is None else by_torque / TORQUE_PER_VOLTAGE


def _judge(least: float, most: float, expected: float | None, outcome: StepOutcome) -> None:
    """Judge the constant. ``expected``: by the torque constant, which rests on 6075h and 6076h."""
    if expected is None:
        outcome.say("no torque constant was measured to hold it against")
        return
    outcome.figures["by_torque_constant"] = expected
    outcome.say(f"by the torque constant it is {expected:.4g} V s/rad")
    ratio = expected / most if expected > most else least / expected
    if ratio > _CONTRADICTION:
        raise StepFailed(
            f"torque constant and DC link contradict each other by {ratio:.3g}",
            "; ".join(outcome.lines),
            "6076h, 6075h, or torque_nm or current_a of the nameplate is wrong, on which every torque here "
            "rests (or the drive weakens the field)",
        )
    if ratio > _DOUBT:
        slip = likely_slip(ratio, TORQUE_SLIPS, tolerance=_USED)
        outcome.faults.append(
            f"torque constant and DC link contradict each other by {ratio:.3g}{slip and f' ({slip})'}: "
            "6076h, 6075h or the nameplate is wrong, and every torque with it"
        )
