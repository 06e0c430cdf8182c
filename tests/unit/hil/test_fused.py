"""The host's predictor on count and speed against matrices with the same gains, and its answers to strays."""

import math
from typing import Final

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

from servobench.design.speed.predictor_plant import PredictorPlant
from servobench.drivers.errors import BadInput
from servobench.drivers.exchange import Command, Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.configuration.controller_kinds import ControllerFile
from servobench.hil.control.predictor import STRAYS, FusedPredictor
from servobench.hil.loop.protocol import Context
from servobench.hil.loop.samples import Sample, StateEstimate
from servobench.hil.loop.scenario import ReferenceProfile
from tests.unit.hil.test_config import load, tables

Array = NDArray[np.float64]
PERIOD = Duration(NS_PER_MS)
TICK: Final = 62_500
PLANT = PredictorPlant(8e-4, 1.85e-3, math.tau * 800.0, math.tau * 500.0)
DEAD_TIME = Duration(100_000)
GAINS: Final = [
    [[400.0, -0.13], [370.0, -0.12], [0.8, -2.7e-4], [-80.0, 0.027]],
    [[350.0, -0.10], [340.0, -0.10], [0.9, -3.0e-4], [-60.0, 0.020]],
    [[300.0, -0.05], [310.0, -0.06], [0.95, -3.5e-4], [-40.0, 0.010]],
]
ALONE: Final = [0.2, 0.18, -0.02]
SPREAD_RAD = 1e-3


def predicting(tick: int = 0, spread_rad: float = SPREAD_RAD) -> FusedPredictor:
    return FusedPredictor(PLANT, GAINS, ALONE, spread_rad, Duration(tick), DEAD_TIME, PERIOD)


def sample(number: int, at: int, speed: float, angle: float) -> Sample:
    told_at = Instant(at if math.isfinite(angle) else at - 1)
    reading = Reading(speed, None, Instant(at), angle, told_at, 0.0, Instant(at), 0, Instant(at))
    return Sample(number, reading, Instant(at), 0, True)


def estimate(predictor: FusedPredictor, acts_at: int) -> StateEstimate:
    context = Context(PERIOD, ReferenceProfile([]))
    context.begin(1, Instant(0), 0.0, 0.0, Instant(acts_at), Instant(acts_at))
    return predictor.estimate(context)


def generator() -> Array:
    """Of [T, omega, w, angle, T_L, u]."""
    lever, a, f = 1.0 / PLANT.inertia_kg_m2, PLANT.current_rate_rad_s, PLANT.filter_rate_rad_s
    rates = np.zeros((6, 6))
    rates[0, 0], rates[0, 5] = -a, a
    rates[1, :5] = [lever, -PLANT.viscous_friction_nm_s * lever, 0.0, 0.0, -lever]
    rates[2, 1:3], rates[3, 1] = [f, -f], 1.0
    return rates


def test_the_filter_is_that_of_its_gains_through_losses_and_commands() -> None:
    draw = np.random.default_rng(40)
    predictor, x, force = predicting(spread_rad=1e3), np.zeros(5), 0.0
    at, number = int(PERIOD), 1
    predictor.receive(sample(number, at, 5.0, 1.0))
    x[1] = x[2] = 5.0
    x[3] = 1.0
    for _ in range(60):
        lost = int(draw.integers(0, 5))
        torque = float(draw.normal(0.0, 0.5))
        acts_at = at + 300_000
        predictor.sent(Command(number, torque, Instant(acts_at - DEAD_TIME), Instant(acts_at)))
        following = at + (lost + 1) * PERIOD
        for begin, end, u in ((at, acts_at, force), (acts_at, following, torque)):
            x = (scipy.linalg.expm(generator() * (end - begin) / NS_PER_S) @ np.append(x, u))[:5]
        at, force, number = following, torque, number + lost + 1
        speed, angle = x[2] + draw.normal(0.0, 0.1), x[3] + draw.normal(0.0, 1e-3)
        x[1:] += np.array(GAINS[min(lost, 2)]) @ [angle - x[3], speed - x[2]]
        predictor.receive(sample(number, at, speed, angle))
        found = estimate(predictor, at - DEAD_TIME)
        assert found.velocity_rad_s == pytest.approx(x[1], abs=1e-3)
        assert predictor.load_nm == pytest.approx(x[4], abs=1e-3)


def turned(predictor: FusedPredictor, lates: list[int], speed: float, ticks: list[int]) -> list[float]:
    """Feed samples of a shaft at constant ``speed``, driven against its friction: SYNCs ``lates`` ns late,
    counts of ticks ``ticks`` later than those of SYNCs that are not. Return the estimated loads."""
    predictor.sent(Command(1, PLANT.viscous_friction_nm_s * speed, Instant(0), Instant(0)))
    loads = []
    for number, (late, tick) in enumerate(zip(lates, ticks, strict=True), start=1):
        angle = speed * (number * PERIOD + tick * TICK) / NS_PER_S
        predictor.receive(sample(number, number * PERIOD + late, speed, angle))
        loads.append(predictor.load_nm)
    return loads


def test_a_late_sync_finds_the_same_tick_or_the_next() -> None:
    lates, ticks = [0] * 10, [0] * 10
    lates[5], lates[7], ticks[7] = 30_000, 30_000, 1
    speed = 80.0
    plain, knowing = (turned(predicting(tick), lates, speed, ticks) for tick in (0, TICK))
    assert np.ptp(plain) > 0.15
    assert np.ptp(knowing) < 0.01


def test_a_count_of_another_instant_is_not_taken_for_a_load() -> None:
    """As if the ticks had drifted past a SYNC: from there on, each count is of a tick before."""
    speed, ticks = 400.0, [0] * 5 + [-1] * 5
    slip_rad = speed * TICK / NS_PER_S
    assert slip_rad > 2.0 * STRAYS * SPREAD_RAD
    loads = turned(predicting(TICK), [0] * 10, speed, ticks)
    assert np.ptp(loads) < 0.02 * slip_rad * abs(GAINS[0][3][0])


def test_without_a_count_the_speed_alone_corrects() -> None:
    predictor = predicting(TICK)
    for number in range(1, 4):
        predictor.receive(sample(number, number * PERIOD, 5.0 if number == 3 else 0.0, math.nan))
    assert predictor.load_nm == pytest.approx(ALONE[2] * 5.0)
    for number in range(4, 7):  # and takes the count when there is one
        predictor.receive(sample(number, number * PERIOD, 5.0, 0.005 * number))
    assert math.isfinite(predictor.load_nm)
    assert math.isfinite(estimate(predictor, 8 * PERIOD).velocity_rad_s)


def section(**changes: object) -> dict[str, object]:
    return {
        "kind": "fused",
        "period_us": 1000,
        "inertia_kg_m2": 8e-4,
        "current_bandwidth_hz": 800.0,
        "speed_filter_hz": 500.0,
        "gains": GAINS,
        "speed_gains": ALONE,
        "count_spread_rad": SPREAD_RAD,
        "speed_gain_nm_s_rad": 0.2,
        **changes,
    }


def test_a_bench_with_it_has_position_and_speed_in_one_frame() -> None:
    raw = tables()
    assert not load(raw).counted("axis1")
    raw["drive"]["axis1"]["controller"] = section()
    assert load(raw).counted("axis1")
    raw["drive"]["axis1"]["count_with_speed"] = False
    assert not load(raw).counted("axis1")


def test_gains_of_another_shape_are_refused() -> None:
    raw = tables()
    raw["drive"]["axis1"]["controller"] = section(gains=[GAINS[0][:3]])
    with pytest.raises(BadInput, match=r"drive\.axis1\.controller\.gains"):
        load(raw)
    assert ControllerFile.model_validate({"controller": section()}).controller.kind == "fused"
