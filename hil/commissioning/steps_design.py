"""Steps that use the figures: limits, period, controller, and a run with them."""

import math
from typing import Final

import numpy as np

from servobench.design.delay.delay_loop import Feedback, speed_model
from servobench.design.errors import DesignError
from servobench.design.motor import PmsmParameters, Transform
from servobench.design.speed.speed_design import least_gain
from servobench.drivers.canopen.pdo_budget import budget_of
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.hil.commissioning.findings import StepFailed, StepOutcome, refuse_losses
from servobench.hil.commissioning.plots import draw_verification
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import PERIODS_US, Session
from servobench.hil.commissioning.steps_dynamics import total_delay_s
from servobench.hil.control.controllers import Pid, PidGains
from servobench.hil.loop.scenario import Ramp, ReferenceProfile, Segment

_MARGIN: Final = 1.6
"""Factor of the measured delay for which the controller is designed."""
_NOISE_TORQUE: Final = 0.05
"""Rms of the torque caused by the velocity's noise, as a share of the rated torque."""
_SHAKING: Final = 0.5
"""Loop gain at a resonance: half of that with which it shakes, whatever the phase."""
_GAIN_DELAY: Final = 0.6
"""Crossing frequency times delay of the designs, about."""
_LOAD_MAX_PERCENT: Final = 60.0
"""Less than a commissioning uses: more drives and other devices will follow."""
_ROOM: Final = 1.25
"""The measured delays are medians; a quarter more covers their spread."""
_VERIFY_SHARE: Final = 0.5
"""Share of the speed limit: overshoots stay within it."""
_RAMP_S: Final = 0.25
"""Long against the speed loop, so that a plateau is reached without a step in torque."""
_HOLD_S: Final = 0.5
"""Its second half is judged: the loop has settled by then."""
_SETTLED: Final = 25.0
"""Time of a plateau times the crossing frequency: the integral is a third as fast as that."""
_ERROR_MAX: Final = 0.02
"""Rms error, as a share of the plateau's speed."""
_UNITS_MAX: Final = 3.0
"""Units of 606Ch, if they are coarse: its rounding, amplified by the loop."""


class Suggest(Step):
    """Suggests limits, sampling period and controller from the measurements."""

    name = "suggest"
    title = "Suggested limits, period and controller"
    limit = "no controller is found for the measured delay"
    needs = ("mechanics", "delays")

    def left_out(self, session: Session) -> str | None:
        return (
            None if session.torque_mode() is not None else "the drive has no torque mode to close a loop with"
        )

    def plan(self, session: Session, /) -> str:
        known = session.found.reading_delay_us is not None
        delay = f" of {1e6 * total_delay_s(session):.0f} us" if known else ""
        return f"design a PI speed controller for {_MARGIN:g} times the measured delay{delay}"

    def run(self, session: Session, outcome: StepOutcome) -> None:
        mechanics, findings = session.mechanics, session.found
        designed_s = _MARGIN * total_delay_s(session)
        lag_s = max(1e-5, 1e-6 * (findings.torque_lag_us or 100.0))
        viscous = max(mechanics.viscous_friction_nm_s, 1e-9)
        # With one N m per ampere the gains come out in N m.
        model = speed_model(_shaft(mechanics.inertia_kg_m2, viscous, lag_s), integral=True)
        # The gain goes with the inverse of the delay: where noise forbids it, a longer one is designed for.
        quiet = _NOISE_TORQUE * session.drive.rated_torque_nm / max(findings.speed_noise_rad_s, 1e-12)
        cause = "the velocity's noise"
        shaking = findings.resonance
        if shaking is not None and _SHAKING / shaking.magnitude < quiet:
            quiet, cause = _SHAKING / shaking.magnitude, f"the resonance at {shaking.frequency_hz:.3g} Hz"
        delay_s = max(designed_s, _GAIN_DELAY * mechanics.inertia_kg_m2 / quiet)
        if delay_s > designed_s:
            outcome.say(f"{cause} allows {quiet:.3g} N m s/rad, so it is designed for {1e6 * delay_s:.0f} us")
        try:
            design = session.meanwhile(least_gain, model, delay_s, Feedback.SPEED)
        except DesignError as error:
            raise StepFailed("no controller was found", str(error)) from error
        proportional, integral = rounded(-float(design.K[1])), rounded(-float(design.K[2]))
        findings.controller = {
            "kind": "pid",
            "proportional_nm_s_rad": proportional,
            "integral_nm_rad": integral,
            "feedforward_nm_s_rad": rounded(mechanics.viscous_friction_nm_s),
        }
        period_us, limits = _period_us(session), suggested_limits(session)
        crossing = proportional / mechanics.inertia_kg_m2
        outcome.say(
            f"PI: {proportional:.4g} N m s/rad and {integral:.4g} N m/rad, crossing at {crossing:.0f} rad/s; "
            f"a load of 1 N m moves the speed by at most {design.gain:.3g} rad/s as a sine"
        )
        outcome.measured("proportional gain", proportional, "N m s/rad")
        outcome.measured("integral gain", integral, "N m/rad")
        outcome.say(f"sampling period {period_us} us")
        outcome.figures = {
            "proportional_nm_s_rad": proportional,
            "integral_nm_rad": integral,
            "crossing_rad_s": crossing,
            "designed_for_delay_us": 1e6 * delay_s,
            "period_us": period_us,
            **limits,
        }
        outcome.say(
            f"limits: {limits['speed_max_rpm']:.0f} r/min, {limits['torque_max_nm']:.4g} N m, "
            f"{limits['torque_slew_max_nm_s']:.4g} N m/s"
        )


def rounded(value: float) -> float:
    """Round to four digits, as in a file written by hand."""
    return float(f"{value:.4g}")


def _shaft(inertia: float, viscous: float, lag_s: float) -> PmsmParameters:
    """Return a motor with one N m per ampere whose current follows with ``lag_s``."""
    return PmsmParameters(
        name="identified",
        resistance_ohm=1.0,
        inductance_d_h=lag_s,
        inductance_q_h=lag_s,
        flux_linkage_wb=1.0,
        pole_pairs=1,
        inertia_kg_m2=inertia,
        viscous_friction_nm_s=viscous,
        coulomb_friction_nm=0.0,
        transform=Transform.POWER_INVARIANT,
        rated_torque_nm=1.0,
        rated_speed_rad_s=1.0,
        current_max_a=1.0,
        dc_bus_voltage_v=1.0,
    )


def _period_us(session: Session) -> int:
    """Return the shortest period for bus and delays: readings are in before the command has to go."""
    findings = session.found
    assert findings.plan is not None
    needed_us = _ROOM * ((findings.reading_delay_us or 0.0) + 0.5 * (findings.effect_delay_us or 0.0))
    for period_us in (500, *PERIODS_US):
        period = Duration(period_us * NS_PER_US)
        load = budget_of([findings.plan], period, session.request.bitrate_bit_s).load_percent
        if load <= _LOAD_MAX_PERCENT and period_us >= needed_us:
            return period_us
    return PERIODS_US[-1]


def suggested_limits(session: Session) -> dict[str, float]:
    """Return the suggested limits; none without a drive that was set up."""
    if not session.configured:
        return {}
    rating, rated_nm = session.request.nameplate.rating, session.drive.rated_torque_nm
    peak = 2.0
    if rating.current_max_a and rating.current_a:
        peak = min(peak, rating.current_max_a / rating.current_a)
    return {
        "speed_max_rpm": rounded(rating.speed_rpm or 2.0 * session.limits.speed_rad_s / RAD_S_PER_RPM),
        "torque_max_nm": rounded(peak * rated_nm),
        "torque_slew_max_nm_s": rounded(rated_nm / 0.005),
    }


def _hold_s(session: Session) -> float:
    """Return the time of a plateau: the loop settles in its first half, also one made slow by a resonance."""
    proportional, mechanics = session.found.controller.get("proportional_nm_s_rad"), session.found.mechanics
    if not proportional or mechanics is None:
        return _HOLD_S
    return max(_HOLD_S, _SETTLED * mechanics.inertia_kg_m2 / float(proportional))


class Verify(Step):
    """Runs the suggested controller on the drive."""

    name = "verify"
    title = "Verification run"
    limit = "the speed is off by more than 2 % rms on a plateau"
    needs = ("suggest",)
    moves = True

    def plan(self, session: Session, /) -> str:
        speed = self._speed(session) / RAD_S_PER_RPM
        return f"follow ramps to +-{speed:.0f} r/min with the suggested controller"

    def _speed(self, session: Session) -> float:
        limits = session.limits
        way_s = _RAMP_S + _hold_s(session)
        return min(_VERIFY_SHARE * limits.speed_rad_s, 0.8 * limits.travel_rad / way_s)

    def run(self, session: Session, outcome: StepOutcome) -> None:
        speed = self._speed(session)
        over = max(_RAMP_S, session.mechanics.inertia_kg_m2 * speed / (0.5 * session.limits.torque_nm))
        hold_s = _hold_s(session)
        reference: list[Segment] = []
        time = 0.1
        plateaus = []
        for target in (speed, 0.0, -speed, 0.0):
            reference.append(Ramp(time, target, over))
            plateaus.append((time + over + 0.5 * hold_s, time + over + hold_s, target))
            time += over + hold_s
        gains = {name: gain for name, gain in session.found.controller.items() if name != "kind"}
        with session.exercising() as exerciser:
            recording = exerciser.run(Pid(PidGains(**gains), exerciser.period_s), time, reference)
        refuse_losses(recording.lost, recording.cycles)
        profile = ReferenceProfile(reference)
        at = recording.time
        asked = np.array([profile.value(float(t)) for t in at])
        errors = asked - recording.speed
        settled = [errors[(at >= low) & (at < high)] for low, high, target in plateaus if target]
        rms = max(float(np.sqrt(np.mean(part**2))) for part in settled)
        outcome.say(
            f"on the plateaus the speed is off by {rms:.3g} rad/s rms ({100.0 * rms / speed:.2f} %), "
            f"on the way by at most {float(np.abs(errors).max()):.3g} rad/s"
        )
        outcome.measured("speed error on the plateaus, rms", rms, "rad/s")
        outcome.figures = {"plateau_rms_rad_s": rms, "error_max_rad_s": float(np.abs(errors).max())}
        session.picture(outcome, "verify", draw_verification, recording, at, asked)
        if rms > _ERROR_MAX * speed + _UNITS_MAX * session.velocity_rad_s or math.isnan(rms):
            raise StepFailed("the suggested controller does not hold the speed", outcome.lines[0])
