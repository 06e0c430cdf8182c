"""The steps of ``hil tune``: the gains of a drive's own speed loop, read, computed, written and proved.

Inertia and friction are those of :class:`MechanicsStep`, by speed ramps in the drive's own mode. The loop is
reckoned as

    L(s) = (P + I/s) G(s)

in the maker's units, form and structure (``[gains]`` in drivers/vendors), with the G that a response of the
loop shows (:mod:`servobench.hil.commissioning.loop_response`); without one no gain is computed.

With ``apply`` the gains are written, P first where it rises, the shaft is turned as before, and the response
is measured again: a speed that scatters more than it did, or a demand that is missed, takes them back.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from servobench.design.errors import DesignError, InfeasibleDesign
from servobench.design.speed.drive_loop import (
    DrivePi,
    LoopBehaviour,
    pi_for_bandwidth,
    pi_for_phase_margin,
)
from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.canopen.write_list import WriteList
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import PeerFault
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.vendors.families import gains_for, motor_objects_for
from servobench.drivers.vendors.gain_objects import GAINS, GainObject, GainObjects, LoopGains
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE
from servobench.hil.commissioning.exercise import OVERSPEED
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.loop_tuning import RANGE_HZ, LoopTuning
from servobench.hil.commissioning.request import PlateLimits
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_manual import ManualStep, SpeedUnits, set_up_steps
from servobench.hil.commissioning.steps_mechanics import MechanicsStep, ramp_time
from servobench.hil.commissioning.swing_watch import SwingWatch
from servobench.hil.loop.scenario import Quantity, Ramp, Segment
from servobench.hil.restoring.journal import ObjectKey
from servobench.hil.write_lists import makers_gains

_PROOF_S: Final = 0.6
_WORSE: Final = 3.0
"""Factor of the speed's scatter at which new gains are taken back."""
_QUIET_RPM: Final = 0.5
"""A scatter below this is none, whatever it was before."""
_LOOKS: Final = 3
"""A loop is measured so often at most until it is certain enough."""
_ROUNDS: Final = 3
"""Gains are written so often at most; the second ones are within a few percent."""
_NEAR: Final = 0.02
"""Relative difference to the bandwidth asked for that is left."""
_NEAR_DEG: Final = 1.5
_SWING_SHARE: Final = 0.02
"""Share of the speed limit below which no swing is ended: the scatter decides there."""
_TORQUE_SHARE: Final = 0.5
"""Share of the torque limit, of the torque's change from reading to reading: an unstable loop goes from limit
to limit, however little the shaft turns by it, and noise that does is too much as well."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TuneRequest:
    """One demand, and what is to be done with the gains that meet it."""

    bandwidth_hz: float | None = None
    phase_margin_deg: float | None = None
    """Neither: the gains are shown as they are."""
    apply: bool = False

    @property
    def asks(self) -> bool:
        """True if gains are to be computed."""
        return self.bandwidth_hz is not None or self.phase_margin_deg is not None


def tune_limits(rpm: float, torque_percent: float, turns: float) -> PlateLimits:
    """Return the limits of a tuning."""
    return PlateLimits(speed_max_rpm=rpm, torque_max_percent=torque_percent, turns_max=turns)


class TuneUnits(SpeedUnits):
    """Only a drive's own speed loop can be tuned by speeds."""

    modes = tuple(mode for mode, quantity in QUANTITY_OF_MODE.items() if quantity is Quantity.SPEED)


class TuneMechanics(MechanicsStep):
    """Inertia and friction of the shaft as it is."""

    needs = ("stop",)

    def left_out(self, session: Session) -> str | None:
        """Raise PeerFault, before anything turns, for a drive whose gains are not known."""
        if lack := _lack(session):
            raise PeerFault(lack)
        return super().left_out(session)


class ShowSpeed(ManualStep):
    """Reads the gains of the speed loop."""

    name = "tune"
    title = "Speed loop"
    limit = "the drive does not tell its gains"
    moves = False

    def __init__(self, how: TuneRequest) -> None:
        self._how = how

    def lack(self, session: Session) -> str:
        return _lack(session)

    def plan(self, session: Session, /) -> str:
        return f"read {_names(session)}, and write nothing"

    def move(self, session: Session, outcome: StepOutcome) -> None:
        _read(session, outcome)


class TuneSpeed(ShowSpeed):
    """Computes others too, writes and proves them."""

    limit = "the demand cannot be met, or the shaft scatters more than before"
    needs = ("stop", "mechanics")
    moves = True

    def plan(self, session: Session, /) -> str:
        limits = session.limits
        write = "and write nothing"
        if self._how.apply:
            write = (
                "write them, and turn it again: a speed that scatters more than before, or a demand that is "
                "missed, takes them back"
            )
        return (
            f"read {_names(session)}, turn the shaft at "
            f"{0.5 * limits.speed_rad_s / RAD_S_PER_RPM:.3g} r/min and swing its speed by sines, with "
            f"{limits.torque_nm:.4g} N m at most, compute P and I, {write}; it is stopped by any key, at "
            f"{OVERSPEED * limits.speed_rad_s / RAD_S_PER_RPM:.4g} r/min, and "
            f"{limits.travel_rad / math.tau:.4g} turns from here"
        )

    def move(self, session: Session, outcome: StepOutcome) -> None:
        loop, held = _loop(session), _read(session, outcome)
        if loop.lack:
            raise StepFailed(loop.lack, "; ".join(outcome.lines), "use the maker's tool")
        tuning = LoopTuning(session, outcome, loop, _torque_factor(session, loop), held)
        raw = tuning.raw(self._made(tuning))
        for _ in range(1, _LOOKS):
            if not tuning.uncertain({**held, **raw}):
                break
            tuning.look(held)
            raw = tuning.raw(self._made(tuning))
        outcome.say(tuning.told)
        tuning.tell("as it is", tuning.figures(held))
        outcome.figures["raw"] = dict(raw)
        for key, value in raw.items():
            each = loop.objects[key]
            outcome.say(f"{object_name(each.index, each.sub)}, {GAINS[key]}: {held[key]:g} to {value:g}")
        tuning.tell("with these", tuning.figures({**held, **raw}))
        if doubt := tuning.uncertain({**held, **raw}):
            outcome.say(doubt)
            if self._how.apply:
                raise StepFailed(
                    f"{doubt}: nothing is written",
                    "; ".join(outcome.lines),
                    "give more speed (--rpm), or ask for less",
                )
        if self._how.apply:
            self._apply(tuning, held, raw)

    def _made(self, tuning: LoopTuning) -> DrivePi:
        how = self._how
        try:
            if how.bandwidth_hz is not None:
                if how.bandwidth_hz > tuning.known_to_hz:
                    raise InfeasibleDesign(
                        f"a bandwidth of {how.bandwidth_hz:g} Hz",
                        f"the loop is measured up to {tuning.known_to_hz:.0f} Hz",
                        "ask for less, or for a shorter period of the SYNC",
                    )
                return pi_for_bandwidth(tuning.plant, how.bandwidth_hz)
            assert how.phase_margin_deg is not None, "asks"
            return pi_for_phase_margin(tuning.plant, how.phase_margin_deg, RANGE_HZ[0], tuning.known_to_hz)
        except DesignError as error:
            raise StepFailed(
                str(error), "; ".join(tuning.outcome.lines), "the drive keeps its gains"
            ) from error

    def _missed(self, figures: LoopBehaviour) -> str:
        """Return what of the demand is missed; empty if nothing is."""
        how = self._how
        if how.bandwidth_hz is not None:
            reached, asked = figures.bandwidth_hz, how.bandwidth_hz
            return "" if abs(reached / asked - 1.0) < _NEAR else f"{reached:.3g} of {asked:g} Hz"
        assert how.phase_margin_deg is not None, "asks"
        margin, asked = figures.margins.phase_margin_deg, how.phase_margin_deg
        return "" if abs(margin - asked) < _NEAR_DEG else f"{margin:.3g} of {asked:g} degrees"

    def _apply(self, tuning: LoopTuning, held: Mapping[str, float], raw: Mapping[str, float]) -> None:
        """Write gains and prove them; write others where what is measured then is not what was asked for.

        Raises StepFailed: the drive is off, and the journal takes back what is not kept.
        """
        session, outcome, loop = tuning.session, tuning.outcome, tuning.loop
        product = session.network.writes.products[session.request.node]
        session.network.writes.allowed |= WriteList("gains", makers_gains(product))
        calm = self._scatter_rpm(session, math.inf)
        now = dict(held)
        for _ in range(_ROUNDS):
            _write(session, loop, now, raw)
            now |= raw
            wild = self._scatter_rpm(session, max(_WORSE * calm, _QUIET_RPM))
            outcome.figures |= {"scatter_rpm_before": calm, "scatter_rpm_after": wild}
            if wild > max(_WORSE * calm, _QUIET_RPM):
                raise StepFailed(
                    f"the speed scatters by {wild:.3g} r/min, {calm:.3g} before: the gains are taken back",
                    "; ".join(outcome.lines),
                    "ask for less",
                )
            tuning.look(now)
            reached = tuning.figures(now)
            if not (missed := self._missed(reached) or tuning.uncertain(now)):
                break
            raw = tuning.raw(self._made(tuning))
        tuning.tell("measured with them", reached)
        outcome.say(f"at speed it scattered by {calm:.3g} r/min before, and by {wild:.3g} after")
        if missed or not reached.stands:
            raise StepFailed(
                f"the loop reaches {missed or 'less than 30 degrees of margin'}: the gains are taken back",
                "; ".join(outcome.lines),
                "ask for less",
            )
        outcome.figures["raw"] = {key: now[key] for key in raw}
        keys = [ObjectKey(loop.objects[key].index, loop.objects[key].sub) for key in raw]
        session.kept = {key for key in keys if key in session.network.taken[session.request.node]}

    def _scatter_rpm(self, session: Session, most_rpm: float) -> float:
        """Turn the shaft both ways; return the root mean square of its speed about the plateaus' means.

        Raises LimitExceeded for a shaft that swings by more than ``most_rpm`` and a share of its speed, or
        whose torque does; not with infinity, for gains that the drive has had all along.
        """
        limits, parts = session.limits, []
        bounded = replace(limits, power_w=math.inf, energy_j=math.inf)
        if most_rpm < math.inf:
            most_rad_s = max(most_rpm * RAD_S_PER_RPM, _SWING_SHARE * limits.speed_rad_s)
            session.port.listener = SwingWatch(most_rad_s, _TORQUE_SHARE * limits.torque_nm).look
        for sign in (1.0, -1.0):
            speed = 0.5 * sign * limits.speed_rad_s
            rise_s = ramp_time(session, speed)
            course: list[Segment] = [Ramp(0.0, speed, rise_s), Ramp(rise_s + _PROOF_S, 0.0, rise_s)]
            with session.exercising(bounded) as exerciser:
                recording = exerciser.run_speeds(2.0 * rise_s + _PROOF_S + 0.3, course)
            late = rise_s + 0.5 * _PROOF_S
            flat = (recording.time > late) & (recording.time < rise_s + _PROOF_S)
            parts.append(recording.velocity[flat] - np.mean(recording.velocity[flat]))
        session.port.listener = None
        return float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) / RAD_S_PER_RPM


def _known(session: Session) -> GainObjects | None:
    identity = session.drive.identity
    assert identity is not None, "the step 'identity' comes first"
    return gains_for(identity.vendor, identity.product, identity.device_name)


def _lack(session: Session) -> str:
    """Return why the gains of this drive cannot be read; empty if they can."""
    known = _known(session)
    loop = None if known is None else known.loops.get("speed")
    if loop is None:
        return "no public document names this maker's gain objects: use the maker's tool"
    for each in (loop.objects[key] for key in ("p", "i") if key in loop.objects):
        if session.objects.read_if_there(each.index, each.sub, "B") is None:
            return f"the drive has no {object_name(each.index, each.sub)}, which its maker's file names"
    return ""


def _loop(session: Session) -> LoopGains:
    known = _known(session)
    assert known is not None, "lack() comes first"
    return known.loops["speed"]


def _held(session: Session, loop: LoopGains, key: str) -> float:
    each = loop.objects[key]
    return each.raw(session.network.upload(session.request.node, each.index, each.sub))


def _write(session: Session, loop: LoopGains, held: Mapping[str, float], raw: Mapping[str, float]) -> None:
    """Write gains and read them back: P before I where it rises, so that no loop is without its damping."""
    order = sorted(raw, key="pid".index, reverse=raw["p"] < held["p"])
    for key in order:
        each, node = loop.objects[key], session.request.node
        data = each.data(raw[key])
        session.network.download(node, each.index, each.sub, data)
        if (now := _held(session, loop, key)) != each.raw(data):
            raise StepFailed(
                f"{object_name(each.index, each.sub)} holds {now:g}", f"{each.raw(data):g} was written"
            )


def _torque_factor(session: Session, loop: LoopGains) -> float:
    """Return the N m of one unit of the loop's output. Raises StepFailed where nothing tells it."""
    if loop.output == "torque":
        return 1.0
    identity = session.drive.identity
    assert identity is not None, "the step 'identity' comes first"
    if loop.ampere == "own":
        for _, known in motor_objects_for(identity.vendor, identity.product, identity.device_name):
            for each in known.objects:
                if each.quantity == "torque_constant_nm_a":
                    data = session.network.upload(session.request.node, each.index, each.sub)
                    return each.value(data)[0]
    rated_ma = session.objects.read_if_there(Object.MOTOR_RATED_CURRENT, 0, "I")
    if not rated_ma:
        raise StepFailed("nothing tells the torque of an ampere", "no 6075h", "use the maker's tool")
    per_rms = session.rated_torque_nm / (1e-3 * rated_ma)
    return per_rms / math.sqrt(2.0) if loop.ampere == "peak" else per_rms


def _names(session: Session) -> str:
    return ", ".join(object_name(each.index, each.sub) for each in _there(session).values())


def _there(session: Session) -> dict[str, GainObject]:
    """Return the objects of the loop that this drive has, by key."""
    return {
        key: each
        for key, each in _loop(session).objects.items()
        if session.objects.read_if_there(each.index, each.sub, "B") is not None
    }


def _read(session: Session, outcome: StepOutcome) -> dict[str, float]:
    """Read and tell all gains of the loop; return them raw."""
    loop = _loop(session)
    held = {key: _held(session, loop, key) for key in _there(session)}
    outcome.figures["held"] = dict(held)
    for key, raw in held.items():
        each = loop.objects[key]
        value, unit = each.value(raw), loop.unit_of(key)
        shown = f" = {value:.6g} {unit}" if value is not None and unit else ""
        outcome.say(f"{object_name(each.index, each.sub)}, {GAINS[key]}: {raw:g}{shown}")
    if loop.rate_hz is not None:
        outcome.say(f"the drive computes the loop at {loop.rate_hz:g} Hz")
    if loop.lack:
        outcome.say(f"{loop.lack}: nothing can be computed")
    return held


def tune_steps(how: TuneRequest) -> list[Step]:
    """Return the steps of ``hil tune``; without a demand nothing turns."""
    then: list[Step] = [TuneMechanics(), TuneSpeed(how)] if how.asks else [ShowSpeed(how)]
    return [*set_up_steps(TuneUnits()), *then]
