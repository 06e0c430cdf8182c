"""Loads over time against a search of every instant by itself."""

import random

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_S
from servobench.virtual_bus.core.native import InnerLoops
from servobench.virtual_bus.drive.load_object import LoadTable

FloatArray = NDArray[np.float64]


def looked_up(times: FloatArray, torques: FloatArray, held: bool, at_s: FloatArray) -> FloatArray:
    """By numpy: straight between points or held; as at the ends beyond them; nothing before 0 s."""
    if held:
        torque = torques[np.clip(np.searchsorted(times, at_s, side="right") - 1, 0, None)]
    else:
        torque = np.interp(at_s, times, torques)
    return np.where(at_s >= 0.0, torque, 0.0)


def borne(table: LoadTable, held: bool, at_s: float, rate_hz: int, count: int) -> FloatArray:
    """The load of each of ``count`` ticks of a motor that is none, the middle of the first at ``at_s``."""
    inner = InnerLoops()
    inner.rate_hz = rate_hz
    inner.bear(table.times_s, table.torques_nm, held, 0.5 / rate_hz - at_s)
    loads = np.full(count, np.nan)
    for tick in range(count):
        inner.advance_to(-(-(tick + 1) * NS_PER_S // rate_hz))
        loads[tick] = inner.load_nm
    return loads


def table_of(times: FloatArray, torques: FloatArray) -> LoadTable:
    return LoadTable(times.astype("<f8").tobytes(), torques.astype("<f8").tobytes())


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize("points", [1, 2, 3, 40, 4000])
def test_any_table_at_any_pace(points: int, held: bool) -> None:
    rng = np.random.default_rng(points)
    for _ in range(20):
        times = np.cumsum(rng.exponential(0.01, points)) + rng.uniform(-0.05, 0.05)
        torques = rng.normal(0.0, 3.0, points)
        table = table_of(times, torques)
        rate_hz, at_s = int(rng.choice([100_000, 1000, 33])), rng.uniform(-0.2, 0.1)
        instants = at_s + np.arange(600) / rate_hz
        loads = borne(table, held, at_s, rate_hz, len(instants))
        assert loads == pytest.approx(looked_up(times, torques, held, instants), rel=1e-9, abs=1e-9)


def test_a_point_holds_from_its_very_instant() -> None:
    table = table_of(np.array([0.0, 1.0, 2.0]), np.array([1.0, 2.0, 4.0]))
    assert borne(table, True, 0.0, 2, 6).tolist() == [1.0, 1.0, 2.0, 2.0, 4.0, 4.0]
    assert borne(table, False, 0.0, 2, 6).tolist() == [1.0, 1.5, 2.0, 3.0, 4.0, 4.0]


def test_before_zero_there_is_no_load_whatever_the_table_says() -> None:
    table = table_of(np.array([-1.0, 1.0]), np.array([5.0, 7.0]))
    assert borne(table, False, -0.5, 4, 4).tolist() == [0.0, 0.0, 6.0, 6.25]


def test_the_number_tells_tables_apart_and_not_their_order_of_reading() -> None:
    draw = random.Random(4)
    times = np.arange(5.0)
    torques = np.array([draw.uniform(-1, 1) for _ in times])
    number = table_of(times, torques).number
    assert number == table_of(times.copy(), torques.copy()).number
    assert 0 < number < 2**32
    others = {table_of(times, torques + 1e-12 * (times == place)).number for place in times}
    others |= {table_of(times + 1e-12 * (times == place), torques).number for place in times}
    assert number not in others
    assert len(others) == 10
