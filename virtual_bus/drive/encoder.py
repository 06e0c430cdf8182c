"""The encoder of a simulated drive: its errors, and how the drive makes its counts into speed."""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from servobench.virtual_bus.core.native import InnerLoops, sine_cosine


class SpeedMethod(IntEnum):
    """How a drive makes counts into speed; the core's numbers."""

    DIFFERENCE = 0
    """Counts of an inner period over that period."""
    EDGES = 1
    """M/T: the way between the last edges of two periods over the time between them."""
    OBSERVER = 2
    """A loop of second order, critically damped, that follows the count."""


@dataclass(frozen=True, slots=True)
class SpeedSensing:
    """From counts to 606Ch."""

    method: SpeedMethod = SpeedMethod.DIFFERENCE
    filter_hz: float | None = 500.0
    """Corner of the first-order filter behind it; None: no filter."""
    timer_hz: float | None = None
    """Clock that times the edges; None: without steps."""
    bandwidth_rad_s: float = 1000.0
    """Bandwidth of the observer."""


BY_DIFFERENCE: Final = SpeedSensing()
"""The default of a simulated drive."""


@dataclass(frozen=True, slots=True)
class SineErrors:
    """Errors of the sine and cosine of a line, of the cosine's amplitude."""

    sine_offset: float = 0.0
    cosine_offset: float = 0.0
    gain: float = 0.0
    """By how much the sine's amplitude is larger."""
    quadrature_rad: float = 0.0
    """By how much they are further apart than a quarter of a line."""


@dataclass(frozen=True, slots=True)
class Encoder:
    """What an encoder does to the angle."""

    lines: int = 1024
    """Signal periods of a turn."""
    sines: SineErrors | None = None
    """None: no errors within a line."""
    eccentricity_rad: float = 0.0
    """Amplitude of the error once a turn."""
    eccentricity_phase_rad: float = 0.0
    delay_s: float = 0.0
    """Age of the angle when the drive has it; up to an inner period."""


def check_encoder(rate_hz: int, encoder: Encoder | None, speed: SpeedSensing) -> None:
    """Error: ValueError for what an inner loop of that rate cannot do."""
    if encoder is not None and not 0.0 <= encoder.delay_s * rate_hz <= 1.0:
        expected = f"at most an inner period, {1e6 / rate_hz:g} us, expected"
        raise ValueError(f"encoder delay {encoder.delay_s * 1e6:g} us: {expected}")
    if speed.filter_hz is not None and not speed.filter_hz > 0.0:
        raise ValueError(f"speed filter {speed.filter_hz} Hz: more than 0 expected")
    if speed.method is SpeedMethod.OBSERVER and not 0.0 < speed.bandwidth_rad_s <= 0.25 * rate_hz:
        expected = f"at most a quarter of the inner rate, {0.25 * rate_hz:g} rad/s, expected"
        raise ValueError(f"speed observer of {speed.bandwidth_rad_s:g} rad/s: {expected}")


def fill_encoder(
    inner: InnerLoops, counts: int, period_s: float, encoder: Encoder | None, speed: SpeedSensing
) -> None:
    """Give ``inner`` an encoder of ``counts`` a turn; ``encoder`` and ``speed`` are checked already."""
    inner.counts = counts
    inner.counts_per_rad = counts / math.tau
    inner.rad_per_count = math.tau / counts
    inner.speed_filter = _filter_gain(speed, period_s)
    inner.speed_method = speed.method.value
    inner.timer_hz = speed.timer_hz or 0.0
    inner.observer_position_gain = 2.0 * speed.bandwidth_rad_s
    inner.observer_speed_gain = speed.bandwidth_rad_s**2
    inner.encoder_active = encoder is not None or speed.method is not SpeedMethod.DIFFERENCE
    if encoder is not None:
        _fill_errors(inner, encoder, period_s)


def _fill_errors(inner: InnerLoops, encoder: Encoder, period_s: float) -> None:
    inner.encoder_distorted = 1
    inner.lines = encoder.lines
    inner.eccentricity_rad, inner.eccentricity_phase_rad = (
        encoder.eccentricity_rad,
        encoder.eccentricity_phase_rad,
    )
    inner.delay_share = encoder.delay_s / period_s
    sines = encoder.sines
    if sines is not None:
        inner.encoder_sines = 1
        inner.sine_offset, inner.cosine_offset = sines.sine_offset, sines.cosine_offset
        shift = sine_cosine(sines.quadrature_rad)
        inner.sine_in_phase, inner.sine_across = (1.0 + sines.gain) * shift[1], (1.0 + sines.gain) * shift[0]
    inner.tabulate_errors()


def _filter_gain(speed: SpeedSensing, period_s: float) -> float:
    return 1.0 if speed.filter_hz is None else period_s / (period_s + 1.0 / (math.tau * speed.filter_hz))


def count_rad_s(counts: int, period_s: float, speed: SpeedSensing) -> float:
    """The speed that a flicker of one count seems to be, rad/s."""
    count_rad = math.tau / counts
    if speed.method is SpeedMethod.EDGES:
        return 0.0  # an edge passed to and fro is no way
    gain = _filter_gain(speed, period_s)
    if speed.method is SpeedMethod.OBSERVER:
        return gain * speed.bandwidth_rad_s * count_rad
    return gain * count_rad / period_s
