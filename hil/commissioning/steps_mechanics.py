"""Steps that identify inertia, friction and the torque constant."""

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Final

import numpy as np

from drivers.canopen.objects import SettingRefused
from drivers.canopen.pdo import PdoDirection, PdoEntry, PdoMap, PdoPlan, bus_load_percent_max
from drivers.cia402.drive_setup import write_optional
from drivers.cia402.objects402 import Object
from drivers.cia402.pdo_plans import mode_plan
from drivers.cia402.profile import Mode
from drivers.cia402.unit_factors import TORQUE_SLIPS, likely_slip
from drivers.errors import TransferAborted
from drivers.rotation import RAD_S_PER_RPM
from drivers.timebase import NS_PER_S, Instant
from hil.commissioning.excitation import SpeedGuide, TimedTorque
from hil.commissioning.exercise import Recording, motions
from hil.commissioning.identify import Mechanics, NotIdentifiable, identify_mechanics
from hil.commissioning.outcome import StepFailed, StepOutcome
from hil.commissioning.plots import draw_current, draw_mechanics
from hil.commissioning.sequence import Step
from hil.commissioning.session import Session, held_s
from hil.loop.scenario import LevelStep, Quantity, Ramp, Segment

_SPEED_SHARE: Final = 0.9
"""Of the speed limit: the rest is room for the overshoot of a guide that knows the shaft only roughly."""
_TORQUE_SHARE: Final = 0.6
"""Of the torque limit, for a ramp: the guide's feedback and friction that is not known yet need the rest."""
_RAMP_S: Final = 0.25
"""The shortest ramp: two windows of the identification and more."""
_SLOWER: Final = 2.5
_PLATEAU_S: Final = 0.4
_PLATEAUS: Final = (0.3, 0.65, 1.0)
"""Of the top speed: three speeds, or viscous and Coulomb friction could not be told apart."""
_COAST_S_MAX: Final = 2.0
"""A shaft that hardly slows down is not waited for."""
_WINDOW_S: Final = 0.1
"""Of the identification: long enough that an encoder's steps average out, short beside a ramp."""
_WINDOW_PERIODS: Final = 20
"""At a long period a window needs samples more than it needs to be short."""
_SLOWEST: Final = 0.03
"""Of the top speed: slower windows may hold a moment at rest, where sliding friction is not what acts."""
_UNCERTAIN: Final = 0.05
"""An inertia with a larger relative error fails the step."""
_SLOW_START_RPM: Final = 20.0
"""A top speed below shows little but friction at the start."""
_CURRENT_S: Final = 1.5
"""Three swings at the slowest, of 2 Hz."""
_CONSTANT_TOLERANCE: Final = 0.1
"""Between the torque constant and the nameplate's: ratings are rounded, and magnets differ by percents."""


class MechanicsStep(Step):
    """Speed ramps both ways and coasting: inertia, viscous and Coulomb friction."""

    name = "mechanics"
    title = "Inertia and friction"
    needs = ("motion_units",)
    moves = True
    writes = True

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
        try:
            window_s = max(_WINDOW_S, _WINDOW_PERIODS * session.found.period / NS_PER_S)
            found = identify_mechanics(
                motions(recordings), window_s, _SLOWEST * speed, held_s=held_s(session)
            )
        except NotIdentifiable as error:
            raise StepFailed("inertia and friction cannot be told from this motion", str(error)) from error
        if session.torque_mode() is None and found.inertia_kg_m2 < 0.0:
            found = _turned_round(session, found, outcome)
        _judge(found, outcome)
        session.found.mechanics = found
        session.found.speed_noise_rad_s = noise = _speed_noise(recordings)
        outcome.figures["speed_noise_rad_s"] = noise
        outcome.say(f"the velocity 606Ch scatters by {noise:.3g} rad/s rms")
        session.picture(outcome, "mechanics", draw_mechanics, recordings, found)


def _speed_noise(recordings: list[Recording]) -> float:
    """Rms of the quick part of the velocity: of each sample less the mean of its neighbours."""
    parts = [
        recording.velocity[1:-1] - 0.5 * (recording.velocity[2:] + recording.velocity[:-2])
        for recording in recordings
    ]
    # Of white noise the difference has 3/2 of the variance.
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2) / 1.5))


def top_speed(session: Session) -> float:
    """The fastest that an exercise goes to, rad/s: within the speed limit and the allowed travel."""
    limits = session.limits
    speed = _SPEED_SHARE * limits.speed_rad_s
    if limits.travel_rad is not None:
        path_s = _RAMP_S + (_PLATEAU_S + _RAMP_S) * sum(_PLATEAUS)
        speed = min(speed, 0.8 * limits.travel_rad / (path_s * _slower(session)))
    return speed


def _slower(session: Session) -> float:
    """How much longer everything lasts: a drive that takes speeds runs its own speed loop, whose torque
    swings."""
    return 1.0 if session.torque_mode() is not None else _SLOWER


def _guide_mechanics(session: Session) -> Mechanics:
    known = session.found.mechanics or session.found.rough
    assert known is not None, "the pulses come first"
    return known


def _ramp_time(session: Session, change: float) -> float:
    """How long a ramp has to take for its torque to stay well below the limit."""
    known = session.found.mechanics or session.found.rough
    if known is None:
        return _RAMP_S
    return max(_RAMP_S, known.inertia_kg_m2 * abs(change) / (_TORQUE_SHARE * session.limits.torque_nm))


def _ramps(session: Session, speed: float) -> list[Recording]:
    """Up by plateaus and down again, both ways.

    A drive that plans its own ramps is given steps, lest it plan one for each cycle.
    """
    port = session.port
    own_ramps = port.mode is Mode.PROFILE_VELOCITY
    slower = _slower(session)
    if own_ramps:
        _write_ramps(session, speed / (slower * _RAMP_S))
    recordings = []
    for direction in (1.0, -1.0):
        reference: list[Segment] = []
        time, last = 0.05, 0.0
        for share in (*_PLATEAUS, 0.0):
            over = slower * _ramp_time(session, (share - last) * speed)
            target = direction * share * speed
            reference.append(LevelStep(time, target) if own_ramps else Ramp(time, target, over))
            time += over + slower * _PLATEAU_S
            last = share
        with session.exercising() as exerciser:
            if exerciser.port.quantity is Quantity.TORQUE:
                guide = SpeedGuide(_guide_mechanics(session), exerciser.period_s)
                recordings.append(exerciser.run(guide, time, reference))
            else:
                recordings.append(exerciser.run_speeds(time, reference))
    return recordings


def _write_ramps(session: Session, acceleration_rad_s2: float) -> None:
    raw = max(1, round(acceleration_rad_s2 / session.told.acceleration_rad_s2))
    for index in (Object.PROFILE_ACCELERATION, Object.PROFILE_DECELERATION):
        write_optional(session.objects, index, "I", raw, "ramp")


def _coasts(session: Session, speed: float) -> list[Recording]:
    """Up to speed, then no torque at all until the shaft is slow, then back to rest."""
    known = _guide_mechanics(session)
    limits = session.limits
    slowing = max(known.coulomb_friction_nm, 1e-3 * limits.torque_nm) / known.inertia_kg_m2
    coast_s = min(_COAST_S_MAX, 0.8 * speed / slowing)
    if limits.travel_rad is not None:
        coast_s = min(coast_s, 0.5 * limits.travel_rad / speed)
    recordings = []
    for direction in (1.0, -1.0):
        over = _ramp_time(session, speed)
        start = 0.05 + over + 0.1
        end = start + coast_s
        reference: list[Segment] = [Ramp(0.05, direction * speed, over), Ramp(end - 1e-6, 0.0, 1e-6)]
        with session.exercising() as exerciser:
            guide = SpeedGuide(known, exerciser.period_s, free=_between(start, end))
            recordings.append(exerciser.run(guide, end + 0.3, reference))
    return recordings


def _turned_round(session: Session, found: Mechanics, outcome: StepOutcome) -> Mechanics:
    """Torque against motion shows only here in a drive that is never given a torque."""
    session.overridden(torque_sign=-session.found.override.torque_sign)
    session.configure()
    outcome.faults.append("polarity: torque 6077h counts against the position; the bench turns its sign")
    return replace(
        found,
        inertia_kg_m2=-found.inertia_kg_m2,
        viscous_friction_nm_s=-found.viscous_friction_nm_s,
        coulomb_friction_nm=-found.coulomb_friction_nm,
        offset_nm=-found.offset_nm,
    )


def _between(low: float, high: float) -> Callable[[float], bool]:
    return lambda time: low <= time < high


def _judge(found: Mechanics, outcome: StepOutcome) -> None:
    outcome.figures = asdict(found)
    outcome.say(f"inertia {found.inertia_kg_m2:.5g} kg m^2 +- {found.inertia_error:.2g}")
    outcome.say(f"viscous friction {found.viscous_friction_nm_s:.4g} N m s/rad +- {found.viscous_error:.2g}")
    outcome.say(f"Coulomb friction {found.coulomb_friction_nm:.4g} N m +- {found.coulomb_error:.2g}")
    outcome.say(f"torque offset {found.offset_nm:.3g} N m; {found.equations} equations")
    if found.inertia_kg_m2 <= 0.0 or found.inertia_error > _UNCERTAIN * found.inertia_kg_m2:
        raise StepFailed(
            "the inertia is not to be trusted", "; ".join(outcome.lines), "is the load coupled softly?"
        )


class TorqueConstant(Step):
    """Torque 6077h against current 6078h, while the shaft swings."""

    name = "torque_constant"
    title = "Torque constant against current"
    needs = ("mechanics",)
    writes = True
    moves = True

    def left_out(self, session: Session) -> str | None:
        if session.torque_mode() is None:
            return "the drive has no torque mode"
        if session.objects.read_if_there(Object.CURRENT_ACTUAL_VALUE, 0, "h") is None:
            return "the drive has no current actual value 6078h"
        return None

    def plan(self, session: Session, /) -> str:
        return f"map 6078h beside 6077h and swing the shaft with {0.6 * session.limits.torque_nm:.4g} N m"

    def run(self, session: Session, outcome: StepOutcome) -> None:
        mode = session.torque_mode()
        assert mode is not None
        try:
            session.configure(mode, _plan_with_current(session))
        except (TransferAborted, SettingRefused) as error:
            session.configure(mode)
            raise StepFailed("6078h cannot be mapped beside the rest", str(error)) from error
        currents: list[tuple[Instant, int]] = []
        cob_id = PdoDirection.TRANSMIT.default_cob_id(1, session.request.node)
        session.network.link.tap(
            lambda _direction, can_id, data, _extended, _remote, at: (
                currents.append((at, int.from_bytes(data[:2], "little", signed=True)))
                if can_id == cob_id
                else None
            )
        )
        try:
            readings = _swing(session)
        finally:
            session.configure(mode)
        torque, current = _paired(readings, currents)
        self._judge(session, torque, current, outcome)

    def _judge(
        self, session: Session, torque: np.typing.NDArray[np.float64],
        permille: np.typing.NDArray[np.float64], outcome: StepOutcome,
    ) -> None:  # fmt: skip
        rated_ma = session.objects.read_if_there(Object.MOTOR_RATED_CURRENT)
        rating = session.request.nameplate.rating
        rated_a = rated_ma / 1e3 if rated_ma else rating.current_a
        if not rated_a:
            raise StepFailed(
                "no rated current", "6075h is missing or 0", "give rating.current_a in the nameplate"
            )
        current = permille * rated_a / 1e3
        if float(np.ptp(current)) < 0.02 * rated_a:
            raise StepFailed(
                "the current 6078h does not follow the torque", f"{np.ptp(current):.3g} A of swing"
            )
        slope, offset = np.polyfit(current, torque, 1)
        rest = torque - (slope * current + offset)
        straightness = 1.0 - float(rest.var() / torque.var())
        session.found.torque_constant_nm_a = float(abs(slope))
        outcome.figures = {"torque_constant_nm_a": float(slope), "straightness": straightness}
        outcome.say(f"{abs(slope):.5g} N m per A rms, straightness {straightness:.4f}, {len(torque)} pairs")
        if slope < 0.0:
            outcome.faults.append("current 6078h and torque 6077h have opposite signs")
        if rating.torque_nm and rating.current_a:
            wanted = rating.torque_nm / rating.current_a
            outcome.say(f"the nameplate's ratings make {wanted:.5g} N m/A")
            outcome.figures["nameplate_nm_a"] = wanted
            if abs(abs(slope) / wanted - 1.0) > _CONSTANT_TOLERANCE:
                by = abs(slope) / wanted
                slip = likely_slip(by, TORQUE_SLIPS, tolerance=0.03)
                outcome.faults.append(
                    f"torque and current contradict the nameplate by {by:.4g}: "
                    f"6075h, 6076h or the nameplate is wrong{f' ({slip})' if slip else ''}"
                )
        session.picture(outcome, "torque_constant", draw_current, current, torque, slope, offset)


def _plan_with_current(session: Session) -> PdoPlan:
    """The current in the frame of the torque, in the place of the statusword, which has a TPDO of its own."""
    mode = session.torque_mode()
    assert mode is not None
    node = session.request.node
    stamped = session.objects.read_if_there(0x1013) is not None
    base = mode_plan(node, mode, device_stamp=stamped, coherent=True)
    actual, speed = base.tpdos
    status, *rest = actual.entries
    current = PdoEntry(Object.CURRENT_ACTUAL_VALUE, 0, "h")
    transmit = PdoDirection.TRANSMIT
    third = PdoMap(transmit, 3, transmit.default_cob_id(3, node), (status,))
    plan = PdoPlan((replace(actual, entries=(current, *rest)), speed, third), base.rpdos)
    load = bus_load_percent_max([plan], session.found.period, session.request.bitrate_bit_s)
    if load > 90.0:
        raise StepFailed("the bus has no room for the current", f"{load:.0f} % load")
    return plan


def _swing(session: Session) -> list[tuple[Instant, float]]:
    """Swing the shaft; the torques with the instants of the frames that told them."""
    known = _guide_mechanics(session)
    limits = session.limits
    amplitude = 0.6 * limits.torque_nm
    omega = max(math.tau * 2.0, amplitude / (known.inertia_kg_m2 * 0.4 * limits.speed_rad_s))
    readings: list[tuple[Instant, float]] = []
    port = session.port
    sign = session.found.override.torque_sign  # as the drive counts: 6078h beside it is taken raw
    port.listener = lambda taken: readings.extend(
        (each.torque_told_at, sign * each.torque_nm) for each in taken
    )
    with session.exercising() as exerciser:
        # By the cosine the speed has no mean.
        exerciser.run(
            TimedTorque(
                lambda time: amplitude * math.cos(omega * time) * min(1.0, time / 0.1), exerciser.period_s
            ),
            _CURRENT_S,
        )
    return readings


def _paired(
    readings: list[tuple[Instant, float]], currents: list[tuple[Instant, int]]
) -> tuple["np.typing.NDArray[np.float64]", "np.typing.NDArray[np.float64]"]:
    """Torque and current of the same frame."""
    by_instant = dict(currents)
    pairs = [(torque, by_instant[at]) for at, torque in readings if at in by_instant]
    if len(pairs) < 50:
        raise StepFailed("torque and current could not be paired", f"{len(pairs)} pairs")
    torque, current = np.array(pairs, dtype=float).T
    return torque, current
