"""The simulated drive's encoder beside closed forms: where it sees a free shaft, and the speed told."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench import run
from servobench.drivers.errors import BadInput, LimitExceeded
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.execution.network_guard import Certificates
from servobench.hil.verdict.verdict import LimitResult
from servobench.virtual_bus.drive.encoder import Encoder, SineErrors, SpeedMethod, SpeedSensing
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from tests.draws import few_of
from tests.motors import LING
from tests.scenario.processes import EXAMPLES

RATE_HZ = 16_000
FREE = replace(LING, viscous_friction_nm_s=0.0, coulomb_friction_nm=0.0)
FloatArray = NDArray[np.float64]


class FreeShaft:
    """A shaft without friction under a constant torque, whose angle is a parabola."""

    def __init__(self, parameters: FirmwareParameters, speed_rad_s: float, acceleration_rad_s2: float = 0.0):
        self.firmware = Firmware(FREE, parameters)
        self.firmware.start(Instant(0))
        self.speed_rad_s, self.acceleration_rad_s2 = speed_rad_s, acceleration_rad_s2
        self.firmware.inner.speed_rad_s = speed_rad_s
        self.firmware.inner.brake_nm = 0.0
        self.firmware.inner.load_nm = -acceleration_rad_s2 * FREE.inertia_kg_m2

    def angle_rad(self, time_s: FloatArray) -> FloatArray:
        return self.speed_rad_s * time_s + 0.5 * self.acceleration_rad_s2 * time_s**2

    def told(self, ticks: int) -> tuple[FloatArray, FloatArray]:
        """Count and speed, rad/s, of each of the next ticks."""
        inner, rows = self.firmware.inner, []
        for _ in range(ticks):
            at_ns = math.ceil((inner.ticks + 1) * NS_PER_S / RATE_HZ)
            self.firmware.advance_to(Instant(at_ns))
            rows.append((inner.count, inner.speed_measured_rad_s))
        counts, speeds = np.array(rows).T
        return counts, speeds


def seen_rad(encoder: Encoder, angle: FloatArray) -> FloatArray:
    """The angle that the signals of an encoder tell, by numpy's arctan2 and without end."""
    error = encoder.eccentricity_rad * np.sin(angle + encoder.eccentricity_phase_rad)
    if encoder.sines is not None:
        e, line = encoder.sines, encoder.lines * angle
        sine = (1.0 + e.gain) * np.sin(line + e.quadrature_rad) + e.sine_offset
        cosine = np.cos(line) + e.cosine_offset
        error = error + np.angle((cosine + 1j * sine) * np.exp(-1j * line)) / encoder.lines
    return angle + error


def drawn_encoder(rng: np.random.Generator) -> Encoder:
    sine, cosine, gain = (float(value) for value in rng.uniform(-0.2, 0.2, 3))
    sines = SineErrors(sine, cosine, gain, math.radians(rng.uniform(-10, 10)))
    return Encoder(
        lines=int(rng.integers(1, 4096)),
        sines=None if rng.random() < 0.2 else sines,
        eccentricity_rad=float(rng.uniform(0.0, 0.1)),
        eccentricity_phase_rad=float(rng.uniform(-math.tau, math.tau)),
        delay_s=float(rng.uniform(0.0, 1.0)) / RATE_HZ,
    )


@pytest.mark.parametrize("seed", few_of(range(40), 10))
def test_counts_are_those_of_the_signals(seed: int) -> None:
    """At either speed, turning round too, of any errors and delay; rounding may move an edge by 1e-9 rad."""
    rng = np.random.default_rng([43, seed])
    encoder, counts = drawn_encoder(rng), int(2 ** rng.uniform(4, 24))
    parameters = FirmwareParameters(encoder_counts_per_revolution=counts, encoder=encoder)
    speed, acceleration = float(rng.uniform(-150.0, 150.0)), float(rng.uniform(-2000.0, 2000.0))
    shaft = FreeShaft(parameters, speed, acceleration)
    shaft.told(1)  # a delay reaches back to before the test's push
    found, _ = shaft.told(1600)
    times_s = np.arange(2, 1602) / RATE_HZ - encoder.delay_s
    expected = seen_rad(encoder, shaft.angle_rad(times_s)) * counts / math.tau
    slack = 1e-9 * counts
    assert np.all((np.floor(expected - slack) <= found) & (found <= np.floor(expected + slack)))
    assert np.ptp(found) > 0


@pytest.mark.parametrize(
    ("errors", "per_line", "amplitude"),
    [
        (SineErrors(sine_offset=0.01), 1, 0.01),
        (SineErrors(cosine_offset=0.01), 1, 0.01),
        (SineErrors(gain=0.01), 2, 0.005),
        (SineErrors(quadrature_rad=0.01), 2, 0.005),
    ],
)
def test_errors_of_the_signals_have_the_lines_of_the_text_book(
    errors: SineErrors, per_line: int, amplitude: float
) -> None:
    """To first order: an offset is seen once a line, amplitude and phase twice."""
    lines, ticks = 8, 16_000
    parameters = FirmwareParameters(encoder_counts_per_revolution=1 << 24, encoder=Encoder(lines, errors))
    shaft = FreeShaft(parameters, math.tau * 2)  # two turns in the second
    counts, _ = shaft.told(ticks)
    error = counts * math.tau / (1 << 24) - math.tau * 2 * np.arange(1, ticks + 1) / RATE_HZ
    spectrum = np.abs(np.fft.rfft(error)) * 2 / ticks
    assert spectrum[2 * lines * per_line] == pytest.approx(amplitude / lines, rel=0.01)
    spectrum[[0, 2 * lines * per_line]] = 0.0
    assert spectrum.max() < 0.02 * amplitude / lines


def edge_times(shaft: FreeShaft, count: int, edges: FloatArray) -> FloatArray:
    """When a shaft that only speeds up passes the counts ``edges``, s."""
    speed, acceleration = shaft.speed_rad_s, shaft.acceleration_rad_s2
    angle = edges * math.tau / count
    return (np.sqrt(speed**2 + 2.0 * acceleration * angle) - speed) / acceleration


@pytest.mark.parametrize("timer_hz", [None, 1e8, 1e6])
@pytest.mark.parametrize("seed", few_of(range(8), 3))
def test_the_time_between_edges_gives_the_speed(seed: int, timer_hz: float | None) -> None:
    rng = np.random.default_rng([44, seed])
    counts = int(rng.integers(16, 20_000))
    speed, acceleration = float(rng.uniform(0.5, 150.0)), float(rng.uniform(1.0, 1000.0))
    sensing = SpeedSensing(SpeedMethod.EDGES, None, timer_hz)
    shaft = FreeShaft(
        FirmwareParameters(encoder_counts_per_revolution=counts, speed=sensing), speed, acceleration
    )
    found, speeds = shaft.told(3200)
    compared, as_timed = 0, 0
    last = 0.0  # the first edge gives no speed yet
    for k in range(1, 3200):
        if found[k] == found[k - 1]:
            continue
        if last > 0.0:
            begin_s, end_s = edge_times(shaft, counts, np.array([last, found[k]]))
            if timer_hz is not None:
                begin_s, end_s = (math.floor(at_s * timer_hz) / timer_hz for at_s in (begin_s, end_s))
            expected = (found[k] - last) * math.tau / counts / (end_s - begin_s)
            as_timed += speeds[k] == pytest.approx(expected, rel=1e-7)
            compared += 1
        last = found[k]
    assert compared > 2
    assert as_timed > 0.99 * compared, "an edge within a rounding of the timer's step may fall to either side"


def test_between_edges_a_speed_falls_with_the_time_that_has_passed() -> None:
    """A shaft that stops just behind an edge is not told to turn on for ever."""
    sensing = SpeedSensing(SpeedMethod.EDGES, None)
    shaft = FreeShaft(FirmwareParameters(encoder_counts_per_revolution=1000, speed=sensing), 30.0)
    shaft.told(400)
    shaft.firmware.inner.speed_rad_s = 0.0
    _, speeds = shaft.told(1600)
    behind_s = np.arange(1, 1601) / RATE_HZ
    assert np.all(speeds[3:] <= math.tau / 1000 / behind_s[2:-1])
    assert np.all(speeds > 0.0)


def test_an_edge_passed_to_and_fro_is_no_speed() -> None:
    sensing = SpeedSensing(SpeedMethod.EDGES, None)
    shaft = FreeShaft(FirmwareParameters(encoder_counts_per_revolution=64, speed=sensing), 0.0)
    for _ in range(50):
        for speed in (1.0, -1.0, -1.0, 1.0):  # +-62.5 urad about the edge at 0
            shaft.firmware.inner.speed_rad_s = speed
            counts, speeds = shaft.told(1)
            assert speeds[0] == 0.0
            assert counts[0] in (0.0, -1.0)


@pytest.mark.parametrize("bandwidth_rad_s", [50.0, 200.0, 1000.0])
def test_an_observer_follows_as_two_equal_poles_do(bandwidth_rad_s: float) -> None:
    """A shaft that is struck: w (1 - (1 + b t) exp(-b t)); an Euler step of b h is off by as much."""
    sensing = SpeedSensing(SpeedMethod.OBSERVER, None, bandwidth_rad_s=bandwidth_rad_s)
    shaft = FreeShaft(FirmwareParameters(encoder_counts_per_revolution=1 << 28, speed=sensing), 100.0)
    _, speeds = shaft.told(2000)
    passed = bandwidth_rad_s * np.arange(1, 2001) / RATE_HZ
    expected = 100.0 * (1.0 - (1.0 + passed) * np.exp(-passed))
    assert np.abs(speeds - expected).max() < 100.0 * bandwidth_rad_s / RATE_HZ
    assert speeds[-1] == pytest.approx(100.0, rel=1e-3) or bandwidth_rad_s == 50.0


def test_an_observer_comes_to_rest_with_the_shaft() -> None:
    sensing = SpeedSensing(SpeedMethod.OBSERVER, None)
    shaft = FreeShaft(FirmwareParameters(encoder_counts_per_revolution=4096, speed=sensing), 100.0)
    shaft.told(400)
    shaft.firmware.inner.speed_rad_s = 0.0
    _, speeds = shaft.told(1600)
    assert np.all(np.abs(speeds[-100:]) < 1e-9), "without a count there is no speed"


def test_currents_turn_by_the_angle_that_the_encoder_tells() -> None:
    """The loops hold i_d = 0 in the frame of a disc out of centre; in the rotor's the current is turned."""
    encoder = Encoder(eccentricity_rad=0.05)
    firmware = Firmware(
        replace(FREE, inertia_kg_m2=1e6),
        FirmwareParameters(encoder_counts_per_revolution=1 << 24, encoder=encoder),
    )
    firmware.start(Instant(0))
    firmware.inner.speed_rad_s = 2.0
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(1.0)
    asked_a = 1.0 / FREE.torque_constant_nm_a
    for milliseconds in range(200, 3200, 150):
        firmware.advance_to(Instant(milliseconds * NS_PER_MS))
        inner = firmware.inner
        turned = FREE.pole_pairs * encoder.eccentricity_rad * math.sin(inner.angle_rad)
        assert inner.current_d_a == pytest.approx(-asked_a * math.sin(turned), abs=0.01 * asked_a)
        assert inner.current_q_a == pytest.approx(asked_a * math.cos(turned), abs=0.01 * asked_a)


@pytest.mark.parametrize("method", list(SpeedMethod))
def test_steps_of_the_speed_told(method: SpeedMethod) -> None:
    """4096 counts at 15 r/min, which is a tenth of a count an inner period: rms of each way, r/min."""
    sensing = SpeedSensing(method, 500.0 if method is SpeedMethod.DIFFERENCE else None)
    true_rad_s = 15.0 * math.tau / 60.0
    parameters = FirmwareParameters(encoder_counts_per_revolution=4096, speed=sensing)
    _, speeds = FreeShaft(parameters, true_rad_s).told(16_000)
    rms_rpm = float(np.std(speeds[4000:])) * 60.0 / math.tau
    most = {SpeedMethod.DIFFERENCE: 20.0, SpeedMethod.EDGES: 1e-3, SpeedMethod.OBSERVER: 2.0}[method]
    print(f"{method.name}: {rms_rpm:.3g} r/min")
    assert rms_rpm < most
    assert method is not SpeedMethod.DIFFERENCE or rms_rpm > 5.0
    assert np.mean(speeds[4000:]) == pytest.approx(true_rad_s, rel=5e-3)


def on_encoder(bench: str, counts: int, encoder: dict[str, Any]) -> Bench:
    return Bench.load(EXAMPLES / f"{bench}.toml").changed(
        {
            "drive.axis1.simulation.encoder_counts_per_revolution": counts,
            "drive.axis1.simulation.like": {"encoder": encoder},
        }
    )


def test_the_demo_passes_or_fails_by_how_its_drive_makes_speed() -> None:
    """1024 lines counted fourfold: steps of the difference make torque; timed edges are quiet."""
    counted = run(on_encoder("ling2012", 4096, {}))
    assert [each.metric for each in counted.verdict.limits if each.result is LimitResult.BROKEN] == [
        "torque_rms_nm_max"
    ]
    timed = run(on_encoder("ling2012", 4096, {"speed": {"method": "edges"}}))
    assert timed.verdict.passed
    assert counted.summary.torque_rms_nm is not None
    assert timed.summary.torque_rms_nm is not None
    assert counted.summary.torque_rms_nm > 20.0 * timed.summary.torque_rms_nm


def test_the_lag_of_an_observer_shakes_the_cabinet() -> None:
    """Two poles at 1000 rad/s take 27 degrees at the 240 rad/s of the controller with the notch."""
    assert run(on_encoder("cabinet", 4096, {"speed": {"method": "edges"}})).verdict.passed
    with pytest.raises(LimitExceeded, match="speed"):
        run(on_encoder("cabinet", 4096, {"speed": {"method": "observer"}}))


@pytest.mark.parametrize(
    ("encoder", "key"),
    [
        ({"delay_us": 40.0}, "encoder.delay_us"),
        ({"speed": {"method": "observer", "bandwidth_rad_s": 3000.0}}, "encoder.speed.bandwidth_rad_s"),
        ({"speed": {"method": "tracking"}}, "encoder.speed.method"),
        ({"lines": 0}, "encoder.lines"),
    ],
)
def test_what_an_encoder_cannot_be_is_refused_by_its_key(encoder: dict[str, Any], key: str) -> None:
    rate_hz = 32_000 if "delay_us" in encoder else 8_000
    with pytest.raises(BadInput, match=key):
        run(on_encoder("ling2012", 4096, encoder).changed({"drive.axis1.simulation.inner_rate_hz": rate_hz}))


def test_the_example_of_an_encoder_runs() -> None:
    bench = Bench.load(EXAMPLES / "ling2012.toml").changed(
        {"drive.axis1.simulation.like": str(EXAMPLES / "drives/sine_encoder.toml")}
    )
    assert run(bench).verdict.passed


@pytest.mark.parametrize(
    ("speed", "left"),
    [
        ({}, ()),
        ({"filter_hz": 200.0}, ("difference, 200 Hz, expected difference, 500 Hz",)),
        ({"method": "edges"}, ("edges, no filter, expected difference, 500 Hz",)),
    ],
)
@pytest.mark.parametrize("kind", ["predictor", "hinf"])
def test_a_certificate_is_for_the_speed_that_its_design_knew(
    kind: str, speed: dict[str, Any], left: tuple[str, ...]
) -> None:
    controller = str(EXAMPLES / f"controllers/ling2012-{kind}.toml")
    bench = on_encoder("ling2012", 65_536, {"speed": speed}).changed({"drive.axis1.controller": controller})
    key = "drive.axis1.simulation.like.encoder.speed"
    assert Certificates(bench.config).plans()["axis1"].left == tuple(f"{key}: {text}" for text in left)
