"""The step that compares torque with current: the torque constant."""

import math
from dataclasses import replace
from typing import Final

import numpy as np

from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.canopen.pdo import PdoDirection, PdoEntry, PdoMap, PdoPlan
from servobench.drivers.canopen.pdo_budget import budget_of
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import Features, PlanWish
from servobench.drivers.cia402.unit_factors import TORQUE_SLIPS, likely_slip
from servobench.drivers.errors import TransferAborted
from servobench.drivers.timebase import Instant
from servobench.hil.commissioning.excitation import TimedTorque
from servobench.hil.commissioning.findings import StepFailed, StepOutcome, refuse_losses
from servobench.hil.commissioning.identify import COVERAGE_FACTOR, Array, slope_error
from servobench.hil.commissioning.nameplate import CONSTANT_TOLERANCE, compare_constant, rated_current
from servobench.hil.commissioning.plots import draw_current
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_mechanics import guide_mechanics, tells_torque

_SLOWEST_RAD_S: Final = 2.0 * math.tau
"""Slowest swing: three of them fit into its time."""
_SLEW_SHARE: Final = 0.8
"""Share of the steepest torque at the steepest point of the swing."""
_CURRENT_S: Final = 1.5
"""Three swings at the slowest, of 2 Hz."""


class TorqueConstant(Step):
    """Measures torque 6077h against current 6078h, while the shaft swings."""

    name = "torque_constant"
    title = "Torque constant against current"
    limit = "the current does not follow the torque"
    needs = ("motion_units",)
    moves = True

    def left_out(self, session: Session) -> str | None:
        if session.torque_mode() is None:
            return "the drive has no torque mode"
        if not tells_torque(session):
            return "the drive tells no torque 6077h"
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

    def _judge(self, session: Session, torque: Array, permille: Array, outcome: StepOutcome) -> None:
        rating = session.request.nameplate.rating
        rated_a = rated_current(session)[0] or rating.current_a
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
        # Both are told in thousandths of their rating, and may be rounded alike in all readings.
        rounding = session.rated_torque_nm / 1000.0 / math.sqrt(12.0) / float(current.std())
        uncertainty = COVERAGE_FACTOR * math.hypot(slope_error(current, torque), rounding)
        rest = torque - (slope * current + offset)
        straightness = 1.0 - float(rest.var() / torque.var())
        session.found.torque_constant_nm_a = float(abs(slope))
        outcome.figures = {
            "torque_constant_nm_a": float(slope),
            "torque_constant_error": uncertainty,
            "coverage_factor": COVERAGE_FACTOR,
            "straightness": straightness,
        }
        outcome.measured("torque constant, as the drive has it", abs(slope), "N m/A rms", uncertainty)
        outcome.say(
            f"{abs(slope):.5g} N m per A rms +- {uncertainty:.2g} (k = 2), straightness {straightness:.4f}, "
            f"{len(torque)} pairs"
        )
        if slope < 0.0:
            outcome.faults.append("current 6078h and torque 6077h have opposite signs")
        if rating.torque_nm and rating.current_a:
            plate_nm_a = rating.torque_nm / rating.current_a
            outcome.say(f"the nameplate's ratings make {plate_nm_a:.5g} N m/A")
            outcome.figures["nameplate_nm_a"] = plate_nm_a
            if abs(abs(slope) / plate_nm_a - 1.0) > CONSTANT_TOLERANCE:
                by = abs(slope) / plate_nm_a
                slip = likely_slip(by, TORQUE_SLIPS, tolerance=0.03)
                outcome.faults.append(
                    f"torque and current contradict the nameplate by {by:.4g}: "
                    f"6075h, 6076h or the nameplate is wrong{f' ({slip})' if slip else ''}"
                )
        compare_constant(session.found.motor, abs(slope), outcome)
        session.picture(outcome, "torque_constant", draw_current, current, torque, slope, offset)


def _plan_with_current(session: Session) -> PdoPlan:
    """Return a plan with the current in the frame of the torque, in place of the statusword, which has its
    own TPDO."""
    mode = session.torque_mode()
    assert mode is not None
    node = session.request.node
    stamped = session.objects.read_if_there(Cia301.HIGH_RESOLUTION_TIME_STAMP) is not None
    wish = PlanWish(mode, coherent=True, features=Features(stamp=stamped), mode_apart=False)
    base = mode_plan(node, wish)
    actual, speed = base.tpdos
    status, *rest = actual.entries
    current = PdoEntry(Object.CURRENT_ACTUAL_VALUE, 0, "h")
    transmit = PdoDirection.TRANSMIT
    third = PdoMap(transmit, 3, transmit.default_cob_id(3, node), (status,))
    plan = PdoPlan((replace(actual, entries=(current, *rest)), speed, third), base.rpdos)
    load = budget_of([plan], session.found.period, session.request.bitrate_bit_s).load_percent
    if load > 90.0:
        raise StepFailed("the bus has no room for the current", f"{load:.0f} % load")
    return plan


def _swing(session: Session) -> list[tuple[Instant, float]]:
    """Swing the shaft; return the torques with the instants of their frames."""
    known = guide_mechanics(session)
    limits = session.limits
    speed_change = known.inertia_kg_m2 * 0.4 * limits.speed_rad_s
    # A torque that 6087h held back would have a mean, and the shaft would gain speed by it.
    steepest = _SLEW_SHARE * limits.torque_slew_nm_s
    amplitude = min(0.6 * limits.torque_nm, steepest / _SLOWEST_RAD_S, math.sqrt(steepest * speed_change))
    omega = max(_SLOWEST_RAD_S, amplitude / speed_change)
    readings: list[tuple[Instant, float]] = []
    port = session.port
    sign = session.found.override.torque_sign  # as the drive counts: 6078h beside it is taken raw
    port.listener = lambda taken: readings.extend(
        (each.torque_told_at, sign * each.torque_nm) for each in taken
    )
    with session.exercising() as exerciser:
        # By the cosine the speed has no mean.
        recording = exerciser.run(
            TimedTorque(
                lambda time: amplitude * math.cos(omega * time) * min(1.0, time / 0.1), exerciser.period_s
            ),
            _CURRENT_S,
        )
    refuse_losses(recording.lost, recording.cycles)
    return readings


def _paired(
    readings: list[tuple[Instant, float]], currents: list[tuple[Instant, int]]
) -> tuple[Array, Array]:
    """Return torque and current of the same frame."""
    by_instant = dict(currents)
    pairs = [(torque, by_instant[at]) for at, torque in readings if at in by_instant]
    if len(pairs) < 50:
        raise StepFailed("torque and current could not be paired", f"{len(pairs)} pairs")
    torque, current = np.array(pairs, dtype=float).T
    return torque, current
