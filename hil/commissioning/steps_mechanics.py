"""The step that identifies inertia and friction, and its tools for other steps."""

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any, Final

import numpy as np

from servobench.drivers.canopen.objects import write_greatest
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.commissioning.excitation import GUIDE_RAD_S, SpeedGuide
from servobench.hil.commissioning.exercise import Exerciser, Recording
from servobench.hil.commissioning.findings import StepFailed, StepOutcome, refuse_losses
from servobench.hil.commissioning.identify import (
    COVERAGE_FACTOR,
    Mechanics,
    NotIdentifiable,
    identify_mechanics,
)
from servobench.hil.commissioning.nameplate import compare_inertia
from servobench.hil.commissioning.plots import draw_angle, draw_mechanics, torque_by_angle
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.torque_scale import torque_scale
from servobench.hil.loop.scenario import LevelStep, Quantity, Ramp, Segment

_SPEED_SHARE: Final = 0.9
"""Share of the speed limit: the rest is room for the overshoot of a guide that knows the shaft only
roughly."""
_TORQUE_SHARE: Final = 0.6
"""Share of the torque limit for a ramp: the guide's feedback and unknown friction need the rest."""
_RAMP_S: Final = 0.25
"""The shortest ramp: two windows of the identification and more."""
_RATE_SHARE: Final = 0.8
"""Share of the drive's own acceleration: a speed that lags behind its ramp can catch up."""
_RISE_SHARE: Final = 0.1
"""Share of a ramp in which the torque rises, if 6087h bounds it: the speed then lags by 5 % of the change."""
_ERROR_SHARE: Final = 0.05
"""Share of the speed limit: that error."""
_SLOWER: Final = 2.5
"""A drive in a speed mode follows a ramp by its own loop, whose lag must be short against it."""
_PLATEAU_S: Final = 0.4
"""Long against the speed loop that holds it; the torque of its second part is friction alone."""
_PLATEAUS: Final = (0.3, 0.65, 1.0)
"""Shares of the top speed: three speeds, or viscous and Coulomb friction could not be separated."""
_COAST_S_MAX: Final = 2.0
"""A shaft that hardly slows down is not waited for."""
_WINDOW_S: Final = 0.1
"""Window of the identification: long enough to average an encoder's steps, short against a ramp."""
_WINDOW_PERIODS: Final = 20
"""At a long period a window needs samples more than it needs to be short."""
_SLOWEST: Final = 0.03
"""Share of the top speed: slower windows may include a moment at rest, without sliding friction."""
_REACHED: Final = 0.8
"""Share of the top speed: a loop that settles within a plateau is nearer; the next plateau is at 0.65."""
_UNCERTAIN: Final = 0.05
"""An inertia with a larger relative error fails the step."""
_COMMANDED: Final = 0.05
"""Relative standard uncertainty of a torque that is only commanded: a drive converts it into a current by a
torque constant that it does not measure; magnets lose 0.1 to 0.2 % per kelvin, and are rated to 5 or 10 %."""
_FRAMES_TO_ACT: Final = 5.8
"""From a SYNC until the torque of its cycle acts, in command frames, before it is measured."""
_SLOW_START_RPM: Final = 20.0
"""Below this top speed little but friction shows at the start."""


class MechanicsStep(Step):
    """Runs speed ramps both ways and coasting: inertia, viscous and Coulomb friction."""

    name = "mechanics"
    title = "Inertia and friction"
    limit = (
        "the inertia is uncertain by more than 5 % (15 % by the commanded torque), or more "
        "than 10 % of the readings are lost"
    )
    needs = ("motion_units",)
    moves = True

    def left_out(self, session: Session) -> str | None:
        if session.torque_mode() is None and not tells_torque(session):
            return "the drive tells no torque, and has no torque mode in which it is given one"
        return None

    def plan(self, session: Session, /) -> str:
        speed = top_speed(session)
        coast = ", and let the shaft coast" if session.torque_mode() is not None else ""
        return f"ramp to {speed / RAD_S_PER_RPM:.0f} r/min and back, both ways, with stops on the way{coast}"

    def run(self, session: Session, outcome: StepOutcome) -> None:
        speed = top_speed(session)
        if speed < _SLOW_START_RPM * RAD_S_PER_RPM:
            raise StepFailed("too little travel or speed is allowed", f"{speed:.3g} rad/s could be reached")
        recordings = _ramps(session, speed)
        if session.torque_mode() is not None:
            recordings += _coasts(session, speed)
        refuse_losses(sum(each.lost for each in recordings), sum(each.cycles for each in recordings))
        if session.torque_mode() is None:
            _refuse_cut_speeds(session, recordings, speed)
        mechanics = identified(
            session,
            recordings,
            max(_WINDOW_S, _WINDOW_PERIODS * session.found.period / NS_PER_S),
            "inertia and friction cannot be told from this motion",
            speed_min_rad_s=_SLOWEST * speed,
            with_shift=True,
            torque_unit_nm=session.rated_torque_nm / 1000.0,
        )
        if session.torque_mode() is None and mechanics.inertia_kg_m2 < 0.0:
            mechanics = _turned_round(session, mechanics, outcome)
        if not tells_torque(session):
            mechanics = _by_command(session, mechanics, outcome)
        _judge(mechanics, outcome)
        compare_inertia(session, outcome, mechanics.inertia_kg_m2)
        session.found.mechanics = mechanics
        scale = torque_scale(session.found, session.request.nameplate)
        if scale is not None:
            outcome.say(f"each of them {scale.sentence}")
        session.found.speed_noise_rad_s = noise = _speed_noise(recordings)
        outcome.figures["speed_noise_rad_s"] = noise
        outcome.say(f"the velocity 606Ch scatters by {noise:.3g} rad/s rms")
        session.picture(outcome, "mechanics", draw_mechanics, recordings, mechanics)
        by_angle = torque_by_angle(recordings, mechanics)
        ripple_nm = by_angle.ripple_nm
        outcome.figures["torque_ripple_nm"] = ripple_nm
        if ripple_nm is not None:
            outcome.measured("torque over the angle, half of peak to peak", ripple_nm, "N m")
            outcome.say(
                f"over a turn the torque varies by +-{ripple_nm:.3g} N m; "
                f"a point of it is uncertain by {by_angle.error_nm:.2g} N m (k = 1)"
            )
            session.picture(outcome, "angle", draw_angle, by_angle)


def identified(
    session: Session, recordings: list[Recording], window_s: float, failure: str, **options: Any
) -> Mechanics:
    """Call :func:`.identify_mechanics` with ``options``. Raises StepFailed, as ``failure``."""
    records = [(each.time, each.position, each.torque) for each in recordings]
    try:
        return session.meanwhile(identify_mechanics, records, window_s, held_s=_held_s(session), **options)
    except NotIdentifiable as error:
        raise StepFailed(failure, str(error)) from error


def _refuse_cut_speeds(session: Session, recordings: list[Recording], speed: float) -> None:
    """Refuse a drive that clips its set-points: it shows one speed, at which viscous and Coulomb friction are
    one.

    Raises StepFailed with the drive's limits of speed.
    """
    reached = min(float(np.abs(each.speed).max()) for each in recordings)
    if reached >= _REACHED * speed:
        return
    told = [f"{reached:.3g} of {speed:.3g} rad/s"]
    told += [
        f"{index:04X}h = {held}"
        for index in (Object.MAX_PROFILE_VELOCITY, Object.MAX_MOTOR_SPEED)
        if (held := session.objects.read_if_there(index)) is not None
    ]
    raise StepFailed(
        "the shaft does not reach the speeds that the drive is given",
        "; ".join(told),
        "raise the drive's limits of speed with the maker's tool",
    )


def _held_s(session: Session) -> float | None:
    """Return the delay from a SYNC to the action of its cycle's torque; None if the torque is not
    commanded."""
    if session.torque_mode() is None:
        return None
    findings = session.found
    if findings.reading_delay_us is not None and findings.effect_delay_us is not None:
        return 1e-6 * (findings.reading_delay_us + findings.effect_delay_us)
    return _FRAMES_TO_ACT * session.timing().command_latency / NS_PER_S


def _speed_noise(recordings: list[Recording]) -> float:
    """Return the rms of the fast part of the velocity: each sample less the mean of its neighbours."""
    parts = [
        recording.velocity[1:-1] - 0.5 * (recording.velocity[2:] + recording.velocity[:-2])
        for recording in recordings
    ]
    # Of white noise the difference has 3/2 of the variance.
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2) / 1.5))


def top_speed(session: Session) -> float:
    """Return the highest speed of an exercise, rad/s: within the speed limit and the allowed travel."""
    limits = session.limits
    path_s = _RAMP_S + (_PLATEAU_S + _RAMP_S) * sum(_PLATEAUS)
    return min(_SPEED_SHARE * limits.speed_rad_s, 0.8 * limits.travel_rad / (path_s * _slower(session)))


def _slower(session: Session) -> float:
    """Return the factor by which everything takes longer: a drive that takes speeds runs its own speed loop,
    whose torque swings."""
    return 1.0 if session.torque_mode() is not None else _SLOWER


def guide_mechanics(session: Session) -> Mechanics:
    """Return the shaft's data known so far: enough to guide an exercise."""
    known = session.found.mechanics or session.found.rough
    assert known is not None, "the pulses come first"
    return known


def follow(session: Session, exerciser: Exerciser, duration: float, reference: list[Segment]) -> Recording:
    """Make the shaft follow speeds for ``duration`` s: by the torque of a guide, or by the drive's own
    loop."""
    if exerciser.port.quantity is Quantity.TORQUE:
        guide = SpeedGuide(
            guide_mechanics(session), exerciser.period_s, bandwidth_rad_s=guide_bandwidth_rad_s(session)
        )
        return exerciser.run(guide, duration, reference)
    return exerciser.run_speeds(duration, reference)


def ramp_time(session: Session, change: float) -> float:
    """Return the necessary time of a speed ramp: its torque stays well below the limit, and the drive's own
    ramps delay neither it nor the speed."""
    known, limits = session.found.mechanics or session.found.rough, session.limits
    least_s = max(_RAMP_S, abs(change) / (_RATE_SHARE * limits.acceleration_rad_s2))
    if known is None:
        return least_s
    angular_momentum = known.inertia_kg_m2 * abs(change)
    return max(
        least_s,
        angular_momentum / (_TORQUE_SHARE * limits.torque_nm),
        math.sqrt(angular_momentum / (_RISE_SHARE * limits.torque_slew_nm_s)),
    )


def guide_bandwidth_rad_s(session: Session) -> float:
    """Return the bandwidth of a guide: the torque that corrects an error of :data:`_ERROR_SHARE` follows
    within its response time.

    A loop of bandwidth w answers to an error e by J w e of torque, and by J w^2 e of it in a second; one
    whose torque is slower than that swings ever farther.
    """
    limits = session.limits
    error = _ERROR_SHARE * limits.speed_rad_s
    fastest = math.sqrt(limits.torque_slew_nm_s / (guide_mechanics(session).inertia_kg_m2 * error))
    return min(GUIDE_RAD_S, fastest)


def _ramps(session: Session, speed: float) -> list[Recording]:
    """Run up by plateaus and down again, both ways.

    A drive that plans its own ramps is given steps, so that it does not plan one for each cycle.
    """
    port = session.port
    own_ramps = port.mode is Mode.PROFILE_VELOCITY
    slower = _slower(session)
    if own_ramps:
        _write_ramps(session, min(speed / (slower * _RAMP_S), session.limits.acceleration_rad_s2))
    recordings = []
    for direction in (1.0, -1.0):
        reference: list[Segment] = []
        time, last = 0.05, 0.0
        for share in (*_PLATEAUS, 0.0):
            over = slower * ramp_time(session, (share - last) * speed)
            target = direction * share * speed
            reference.append(LevelStep(time, target) if own_ramps else Ramp(time, target, over))
            time += over + slower * _PLATEAU_S
            last = share
        with session.exercising() as exerciser:
            recordings.append(follow(session, exerciser, time, reference))
    return recordings


def _write_ramps(session: Session, acceleration_rad_s2: float) -> None:
    raw = max(1, round(acceleration_rad_s2 / session.acceleration_rad_s2))
    for index in (Object.PROFILE_ACCELERATION, Object.PROFILE_DECELERATION):
        write_greatest(session.objects, index, "I", raw, "ramp", most=session.most_told(index))


def _coasts(session: Session, speed: float) -> list[Recording]:
    """Run up to speed, then give no torque until the shaft is slow, then bring it to rest."""
    known = guide_mechanics(session)
    limits = session.limits
    slowing = max(known.coulomb_friction_nm, 1e-3 * limits.torque_nm) / known.inertia_kg_m2
    coast_s = min(_COAST_S_MAX, 0.8 * speed / slowing, 0.5 * limits.travel_rad / speed)
    recordings = []
    for direction in (1.0, -1.0):
        over = ramp_time(session, speed)
        start = 0.05 + over + 0.1
        end = start + coast_s
        reference: list[Segment] = [Ramp(0.05, direction * speed, over), Ramp(end - 1e-6, 0.0, 1e-6)]
        with session.exercising() as exerciser:
            guide = SpeedGuide(
                known,
                exerciser.period_s,
                free=_between(start, end),
                bandwidth_rad_s=guide_bandwidth_rad_s(session),
            )
            recordings.append(exerciser.run(guide, end + 0.3, reference))
    return recordings


def _turned_round(session: Session, mechanics: Mechanics, outcome: StepOutcome) -> Mechanics:
    """Detect torque against motion, which shows only here in a drive that is never given a torque."""
    session.overridden(torque_sign=-session.found.override.torque_sign)
    session.configure()
    outcome.faults.append("polarity: torque 6077h counts against the position; the bench turns its sign")
    return replace(
        mechanics,
        inertia_kg_m2=-mechanics.inertia_kg_m2,
        viscous_friction_nm_s=-mechanics.viscous_friction_nm_s,
        coulomb_friction_nm=-mechanics.coulomb_friction_nm,
        offset_nm=-mechanics.offset_nm,
    )


def tells_torque(session: Session) -> bool:
    """Return True if the drive sends 6077h or 6078h."""
    plan = session.found.plan
    return plan is None or any(
        plan.tpdo_with(index) is not None
        for index in (Object.TORQUE_ACTUAL_VALUE, Object.CURRENT_ACTUAL_VALUE)
    )


def _by_command(session: Session, mechanics: Mechanics, outcome: StepOutcome) -> Mechanics:
    """Add the uncertainty of an unmeasured torque; the motion yields the command's delay."""
    outcome.figures["by_command"] = True
    outcome.say(
        "the drive tells no torque (6077h, 6078h): the commanded one is taken, in units of 6076h, with "
        f"{100.0 * COVERAGE_FACTOR * _COMMANDED:g} % (k = 2) for what the drive makes of it"
    )
    session.found.command_to_torque_s = (_held_s(session) or 0.0) + mechanics.torque_shift_s

    def wider(error: float, value: float) -> float:
        return math.hypot(error, COVERAGE_FACTOR * _COMMANDED * value)

    return replace(
        mechanics,
        inertia_error=wider(mechanics.inertia_error, mechanics.inertia_kg_m2),
        viscous_error=wider(mechanics.viscous_error, mechanics.viscous_friction_nm_s),
        coulomb_error=wider(mechanics.coulomb_error, mechanics.coulomb_friction_nm),
    )


def _between(low: float, high: float) -> Callable[[float], bool]:
    return lambda time: low <= time < high


def _judge(mechanics: Mechanics, outcome: StepOutcome) -> None:
    outcome.figures = {
        **asdict(mechanics),
        "coverage_factor": COVERAGE_FACTOR,
        "by_command": outcome.figures.get("by_command", False),
    }
    for name, value, digits, unit, error in (
        ("inertia", mechanics.inertia_kg_m2, 5, "kg m^2", mechanics.inertia_error),
        ("viscous friction", mechanics.viscous_friction_nm_s, 4, "N m s/rad", mechanics.viscous_error),
        ("Coulomb friction", mechanics.coulomb_friction_nm, 4, "N m", mechanics.coulomb_error),
    ):
        outcome.measured(name, value, unit, error)
        outcome.say(f"{name} {value:.{digits}g} {unit} +- {error:.2g} (k = 2, of the fit)")
    outcome.say(f"torque offset {mechanics.offset_nm:.3g} N m; {mechanics.equations} equations")
    bound = _UNCERTAIN + (COVERAGE_FACTOR * _COMMANDED if outcome.figures["by_command"] else 0.0)
    if mechanics.inertia_kg_m2 <= 0.0 or mechanics.inertia_error > bound * mechanics.inertia_kg_m2:
        raise StepFailed(
            "the inertia is not to be trusted", "; ".join(outcome.lines), "is the load coupled softly?"
        )
