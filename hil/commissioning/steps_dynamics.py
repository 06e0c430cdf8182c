"""Steps that measure response times: torque to speed, and the delays of readings and commands."""

import math
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Duration
from servobench.hil.commissioning.command_probe import CommandProbe, switches
from servobench.hil.commissioning.excitation import (
    RISE_MIN,
    ComplexArray,
    FrequencyResponse,
    SpeedGuide,
    StepLag,
    closer_lines_hz,
    frequency_response,
    lines_hz,
    multisine,
    resonance_of,
    step_lag,
)
from servobench.hil.commissioning.findings import StepFailed, StepOutcome, refuse_losses
from servobench.hil.commissioning.identify import Array
from servobench.hil.commissioning.plots import draw_delays, draw_response
from servobench.hil.commissioning.ramps import ramps_told
from servobench.hil.commissioning.request import MotionLimits
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_mechanics import ramp_time, tells_torque
from servobench.hil.configuration.network_file import DelayFigures, Network
from servobench.hil.loop.scenario import Ramp
from servobench.hil.reviewing.network_meter import runs_of

_BLOCK_S: Final = 1.0
"""A period of the multisine: its lines are whole multiples of 1 Hz."""
_BLOCKS: Final = 6
"""Periods to average; the coherence of a single one would always be 1."""
_LINES: Final = 28
"""Some ten per decade: no resonance hides between two of them, and each still has its share of torque."""
_LOWEST_HZ: Final = 2.0
"""A rigid shaft responds to a torque by 1/f: lower lines need much speed, and add nothing."""
_SPAN: Final = 5.0
"""From the lowest line to the highest, at the least: a decade nearly shows the slope of an inertia."""
_SMALL_SHARE: Final = 0.05
"""Share of the rated torque: such small sines are steep at as high a frequency as 6087h allows, and each is
still above a thousandth of the rated torque, the unit of 6077h."""
_NYQUIST_PART: Final = 0.4
"""The highest line, as a share of the sampling rate: below a half, or faster parts would be aliased onto
it."""
_BASE_SHARE: Final = 0.4
"""Share of the speed limit at which the shaft turns: far enough from rest that no swing reverses it."""
_GUIDE_RAD_S: Final = 4.0
"""Bandwidth of the loop that holds the speed: below the lowest line, 12.6 rad/s, so that it affects none."""
_COHERENT: Final = 0.8
"""Below this the noise is a quarter or more of the torque's effect."""
_LARGER: Final = 2.0
"""Over the sines of the whole range: 80 % of the torque limit, for lines close to each other."""
_SMALLER: Final = 0.5
"""Share of the torque in the second look at a resonance: play shows as another frequency."""
_PLAY: Final = 0.01
"""Relative difference of the two frequencies."""
_SAME: Final = 0.005
"""Relative difference of the two frequencies where play cannot be what the coherence is lost by: without any
they are within 0.0015, and with play some 0.03 apart."""
_MIDDLE_HZ: Final = (4.0, 60.0)
"""Range in which a shaft is rigid: above the guide, and below the resonances of couplings."""
_RIGID_SHARE: Final = 0.3
"""Of the frequency of a coupling's notch: up to there its response is within a tenth of a rigid shaft's."""

_FINEST_US: Final = 20.0
"""Uncertainty of an instant of sending; see the delays of commands found by commissioning."""
_SLOPE_PART: Final = 1.0
"""A ramp passes from 10 to 90 % in 0.8 of its time, a lag in 2.2 of its own: with one as long as the lag the
ramp makes more than a third of the rise."""
_READINGS_S: Final = 1.0
"""A thousand readings at 1 kHz, for a 99th percentile out of ten."""


class Response(Step):
    """Measures torque to speed by a multisine while the shaft turns one way."""

    name = "response"
    title = "Frequency response torque to speed"
    limit = (
        "it contradicts the inertia of the ramps by more than a fifth, or more than 10 % of "
        "the readings are lost"
    )
    needs = ("mechanics",)
    moves = True

    def left_out(self, session: Session) -> str | None:
        if session.torque_mode() is None:
            return "the drive has no torque mode"
        if session.limits.travel_rad < math.inf:
            return "the shaft would have to turn one way for seconds"
        if _sines(session)[1] < _SPAN * _LOWEST_HZ:
            return f"the drive lets no torque swing fast enough: {ramps_told(session.found)}"
        return None

    def plan(self, session: Session, /) -> str:
        speed = _BASE_SHARE * session.limits.speed_rad_s / RAD_S_PER_RPM
        return (
            f"turn at {speed:.0f} r/min with {_LINES} sines of torque on top, from {_LOWEST_HZ:g} Hz on, "
            f"for {_BLOCKS * _BLOCK_S:g} s"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        mechanics, limits = session.mechanics, session.limits
        share_nm, highest_hz = _sines(session)
        room = mechanics.inertia_kg_m2 * math.tau * _LOWEST_HZ * 0.3 * _BASE_SHARE * limits.speed_rad_s
        amplitude = min(share_nm, 3.0 * room)
        lines = lines_hz(_LOWEST_HZ, highest_hz, _LINES, _BLOCK_S)
        response = _measured(session, lines, amplitude)
        model = 1.0 / (
            mechanics.inertia_kg_m2 * 1j * math.tau * response.frequency_hz + mechanics.viscous_friction_nm_s
        )
        rise = _judge_response(response, model, outcome)
        session.picture(outcome, "response", draw_response, response, model)
        if rise.ratio > RISE_MIN:
            self._look_closer(session, rise, amplitude, outcome)

    def _look_closer(self, session: Session, rise: "_Rise", usual_nm: float, outcome: StepOutcome) -> None:
        """Measure the resonance near a rise by lines around it, with two amplitudes."""
        lines = closer_lines_hz(rise.near_hz, _BLOCK_S, _sines(session)[1])
        period_s = session.found.period / NS_PER_S
        limits, rigid = session.limits, session.mechanics.inertia_kg_m2 * math.tau * rise.near_hz
        swinging_nm = 0.3 * _BASE_SHARE * limits.speed_rad_s * rigid / rise.ratio
        largest_nm = min(_LARGER * usual_nm, 6.0 * swinging_nm)
        looks = [_measured(session, lines, share * largest_nm) for share in (1.0, _SMALLER)]
        coherence = min(float(np.quantile(look.coherence, 0.25)) for look in looks)
        large, small = (resonance_of(look, period_s) for look in looks)
        session.found.resonance = max(
            filter(None, (large, small)), key=lambda each: each.magnitude, default=None
        )
        apart = abs(small.frequency_hz / large.frequency_hz - 1.0) if large and small else math.inf
        if coherence < _COHERENT:
            why = (
                "commands do not act at even instants, or the speed is noisy"
                if apart < _SAME
                else "the shaft does not answer in proportion to the torque, as behind a coupling with play"
            )
            outcome.say(
                f"near {rise.near_hz:.0f} Hz a quarter of the lines have a coherence below "
                f"{coherence:.2f}: {why}"
            )
            if apart >= _SAME:
                return
        if large is None or small is None:
            outcome.say(f"near {rise.near_hz:.0f} Hz no resonance of two masses fits")
            return
        outcome.figures["resonance_apart"] = apart
        if apart > _PLAY:
            outcome.say(
                f"the resonance goes with the amplitude: {large.frequency_hz:.4g} Hz, and with half of it "
                f"{small.frequency_hz:.4g} Hz; the coupling has play"
            )
        else:
            outcome.measured("resonance", large.frequency_hz, "Hz", 2.0 * apart * large.frequency_hz)
            outcome.say(
                f"resonance at {large.frequency_hz:.4g} Hz, damping {100.0 * large.damping_ratio:.2g} %"
            )
            outcome.figures |= {"resonance_hz": large.frequency_hz, "damping_ratio": large.damping_ratio}


def _measured(session: Session, lines: Array, amplitude_nm: float) -> FrequencyResponse:
    """Return the response at ``lines`` of a shaft that turns one way."""
    mechanics, limits = session.mechanics, session.limits
    base = _BASE_SHARE * limits.speed_rad_s
    with session.exercising(_roomy(limits)) as exerciser:
        period = exerciser.period_s
        added = multisine(lines, amplitude_nm, seed=session.request.node)
        over = max(0.3, ramp_time(session, base), mechanics.inertia_kg_m2 * base / (0.3 * limits.torque_nm))
        start = over + 0.7
        guide = SpeedGuide(
            mechanics,
            period,
            added=lambda time: added(time) if time >= start - 0.4 else 0.0,
            bandwidth_rad_s=_GUIDE_RAD_S,
        )
        recording = exerciser.run(guide, start + _BLOCKS * _BLOCK_S + 0.2, [Ramp(0.0, base, over)])
    refuse_losses(recording.lost, recording.cycles)
    try:
        return session.meanwhile(
            frequency_response, recording.time, recording.torque, recording.velocity,
            lines, _BLOCK_S, period, start,
        )  # fmt: skip
    except ValueError as error:
        raise StepFailed("too few samples for a frequency response", str(error)) from error


def _sines(session: Session) -> tuple[float, float]:
    """Return N m of all sines at most, and Hz of the highest: less if 6087h limits the torque's rise."""
    limits, host, period_s = session.limits, session.found.limits, session.found.period / NS_PER_S
    nyquist_hz = _NYQUIST_PART / period_s
    if host is None or limits.torque_slew_nm_s >= host.torque_slew_nm_s:
        return 0.4 * limits.torque_nm, nyquist_hz
    small_nm = min(0.4 * limits.torque_nm, _SMALL_SHARE * session.rated_torque_nm)
    return small_nm, min(nyquist_hz, limits.torque_slew_nm_s / (0.4 * math.tau * small_nm))


def _roomy(limits: MotionLimits) -> MotionLimits:
    """Enlarge the energy limit: the work of many swings adds up, and time bounds this step."""
    return replace(limits, energy_j=4.0 * limits.energy_j)


class _Rise(NamedTuple):
    """The largest rise above the rigid shaft."""

    ratio: float
    near_hz: float


def _judge_response(measured: FrequencyResponse, model: ComplexArray, outcome: StepOutcome) -> _Rise:
    frequency, response, coherence = measured.frequency_hz, measured.response, measured.coherence
    dips = np.abs(response) / np.abs(model)
    usable = coherence > _COHERENT
    peak = int(np.argmax(np.where(usable, dips, 0.0)))
    low_hz, high_hz = _MIDDLE_HZ
    notch = int(np.argmin(dips[: peak + 1]))
    if dips[peak] > RISE_MIN and dips[notch] < 1.0 / RISE_MIN:
        high_hz = min(high_hz, _RIGID_SHARE * float(frequency[notch]))
        if high_hz < _SPAN * _LOWEST_HZ:
            low_hz, high_hz = _LOWEST_HZ, max(high_hz, 2.0 * _LOWEST_HZ)
    middle = (frequency >= low_hz) & (frequency <= high_hz) & usable
    if not middle.any():
        raise StepFailed("the speed does not follow the torque", f"best coherence {coherence.max():.2f}")
    ratio = float(np.median(np.abs(model[middle]) / np.abs(response[middle])))
    good = frequency[usable]
    outcome.say(f"coherence above {_COHERENT:g} from {good.min():.0f} to {good.max():.0f} Hz")
    outcome.say(f"between {low_hz:g} and {high_hz:.3g} Hz the inertia is {ratio:.3f} of the identified one")
    outcome.measured("inertia over that of the ramps", ratio, "")
    outcome.headline = outcome.lines[-1]
    outcome.say(f"largest rise above the rigid shaft: {dips[peak]:.2f} at {frequency[peak]:.0f} Hz")
    outcome.figures = {
        "inertia_ratio": ratio,
        "coherence_min": float(coherence.min()),
        "coherent_to_hz": float(good.max()),
        "resonance_ratio": float(dips[peak]),
        "frequency_hz": frequency.tolist(),
        "magnitude": np.abs(response).tolist(),
        "phase_deg": np.degrees(np.angle(response)).tolist(),
        "coherence": coherence.tolist(),
    }
    if not 0.8 < ratio < 1.25:
        raise StepFailed("response and ramps disagree on the inertia", f"ratio {ratio:.3f}")
    return _Rise(float(dips[peak]), float(frequency[peak]))


class Delays(Step):
    """Measures the delays of readings and commands, and their losses."""

    name = "delays"
    title = "Delays and losses"
    limit = "more than 10 % of the readings are lost, or the torque does not follow"
    needs = ("motion_units",)
    moves = True

    def plan(self, session: Session, /) -> str:
        if session.torque_mode() is None or not tells_torque(session):
            return f"time {_READINGS_S:g} s of readings; what a command does cannot be timed without torque"
        return (
            f"switch the torque {switches(session)} times by a little, at shifting instants of the cycle, "
            "and see in the readings when it arrives"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        if session.torque_mode() is None or not tells_torque(session):
            _time_readings(session, outcome)
            return
        with session.enabled():
            probe = CommandProbe(session)
            probe.run()
        readings = np.array(probe.delays_us)
        if len(readings) < 100:
            raise StepFailed("too few readings came", f"{len(readings)} of {probe.cycles}")
        refuse_losses(probe.cycles - len(readings), probe.cycles)
        age, part = (np.array(column, dtype=float) for column in zip(*probe.answers, strict=True))
        try:
            lag = session.meanwhile(step_lag, age, part)
        except ValueError as error:
            slope = probe.slope
            if slope is None:
                raise StepFailed("the torque does not follow its command", str(error)) from error
            raise StepFailed(
                "the torque slope 6087h hides when a command acts",
                f"{slope.told}; {error}",
                "cyclic synchronous torque has no slope; the steepest that the drive takes is set",
            ) from error
        findings = session.found
        findings.current_bandwidth_hz = None if probe.hidden_us else _bandwidth_hz(session, lag)
        probe.judge_commands(lag)
        findings.effect_delay_us, findings.torque_lag_us = lag.half_us, lag.lag_us
        lost, commands_lost = sum(probe.missing), probe.commands_lost
        in_a_row = runs_of(np.array(probe.missing, dtype=bool))
        _keep_readings(session, outcome, readings, in_a_row, lost, probe.cycles, lag.half_us, commands_lost)
        told = f"a command shows half of its effect {lag.half_us:.0f} us after it was sent"
        if probe.hidden_us:
            about_us = 0.5 * probe.hidden_us
            outcome.measured("delay of a command", lag.half_us, "us", about_us)
            outcome.say(
                f"{told}, give or take {about_us:.0f} us: the drive samples later than the SYNC, or acts "
                "within a command's time on the bus, so its own lag cannot be told"
            )
        else:
            outcome.measured("delay of a command", lag.half_us, "us")
            outcome.say(f"{told}: {lag.dead_us:.0f} us of dead time and a lag of {lag.lag_us:.0f} us")
        if probe.slope is not None and probe.slope.takes_us > _SLOPE_PART * lag.lag_us:
            outcome.say(f"most of it is the torque slope 6087h: {probe.slope.told}")
        if findings.current_bandwidth_hz is not None:
            outcome.say(f"the drive follows it like a current loop of {findings.current_bandwidth_hz:.0f} Hz")
        outcome.say(f"{commands_lost} of {probe.commands} commands were lost")
        outcome.figures = {
            "reading_delay_us": findings.reading_delay_us,
            "reading_delay_p99_us": float(np.percentile(readings, 99)),
            "effect_delay_us": lag.half_us,
            "dead_time_us": lag.dead_us,
            "lag_us": lag.lag_us,
            "current_bandwidth_hz": findings.current_bandwidth_hz,
            "readings_lost": lost,
            "commands_lost": commands_lost,
            "commands": probe.commands,
            "cycles": probe.cycles,
        }
        session.picture(outcome, "delays", draw_delays, readings, age, part, lag)


def _bandwidth_hz(session: Session, lag: StepLag) -> float | None:
    """Return the bandwidth of the drive's own lag, without the command's way over the bus; None: too short to
    measure."""
    in_drive_us = lag.mean_us - session.timing().command_latency / NS_PER_US
    return 1e6 / (math.tau * in_drive_us) if in_drive_us > _FINEST_US else None


def _time_readings(session: Session, outcome: StepOutcome) -> None:
    """Measure only the readings' delay, with the drive at rest."""
    whole_only, session.port.whole_only = session.port.whole_only, False  # a position is not what is timed
    with session.exercising() as exerciser:
        recording = exerciser.rest(_READINGS_S)
    session.port.whole_only = whole_only
    readings = recording.sync_to_reading_us
    if len(readings) < 100:
        raise StepFailed("too few readings came", f"{len(readings)} of {recording.cycles}")
    refuse_losses(recording.lost, recording.cycles)
    _keep_readings(session, outcome, readings, recording.losses_in_a_row, recording.lost, recording.cycles)
    delay_us = session.found.reading_delay_us
    outcome.figures = {"reading_delay_us": delay_us, "readings_lost": recording.lost}
    by_motion_s = session.found.command_to_torque_s
    if by_motion_s is not None and delay_us is not None:
        session.found.effect_delay_us = effect_us = max(0.0, 1e6 * by_motion_s - delay_us)
        outcome.figures["effect_delay_us"] = effect_us
        outcome.say(f"by the motion a command acts {effect_us:.0f} us after it was sent")


def _keep_readings(
    session: Session,
    outcome: StepOutcome,
    readings_us: Array,
    in_a_row: tuple[int, ...],
    lost: int,
    cycles: int,
    effect_us: float = 0.0,
    commands_lost: int = 0,
) -> None:
    """Record the readings' figures, as in a network file and in words."""
    p50, p99, p999, largest = (float(np.percentile(readings_us, level)) for level in (50, 99, 99.9, 100))
    session.found.reading_delay_us = float(np.median(readings_us))
    session.found.network = Network(
        period_us=max(1, round(session.found.period / 1000)),
        losses_in_a_row_max=len(in_a_row),
        delay_max_us=math.ceil(largest + effect_us),
        command_losses_in_a_row_max=1 if commands_lost else 0,
        cycles=cycles,
        lost=lost,
        loss_percent=100.0 * lost / max(1, cycles),
        losses_in_a_row=in_a_row,
        reading_delay_us=DelayFigures(p50=p50, p99=p99, p999=p999, max=largest),
    )
    outcome.measured("delay of a reading", session.found.reading_delay_us, "us")
    outcome.measured("readings lost", 100.0 * lost / max(1, cycles), "%")
    outcome.say(
        f"readings arrive {session.found.reading_delay_us:.0f} us after the SYNC, "
        f"99 % within {p99:.0f} us; {lost} of {cycles} were lost"
    )


def total_delay_s(session: Session) -> float:
    """Return the time from a sample to the middle of the action of a torque based on it, s."""
    findings = session.found
    reading = findings.reading_delay_us or 0.0
    effect = findings.effect_delay_us or 0.0
    hold: Duration = findings.period
    return (reading + effect) * 1e-6 + 0.5 * hold / NS_PER_S
