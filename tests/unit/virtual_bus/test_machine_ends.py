"""Ends of the axis of a simulated drive: end stops and switches that its motor file has."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest

from servobench.design.mechanism import EndStops, Mechanism, PlacedLoad, Switches
from servobench.design.motor import PmsmParameters
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.virtual_bus.drive.machine import MACHINE
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import COUNTS, LIMITED, SWITCHES, MotionBench
from tests.unit.virtual_bus.test_homing import (
    DONE,
    HOME_FROM,
    HOME_TO,
    MODE_BITS,
    NEGATIVE_AT,
    POSITIVE_AT,
    home,
    home_of,
    prepare,
    zero_count,
)

STOPPED, STOP_SPEED = 9, 10
"""Sub-indices of 2110h."""


def switched(bounce_s: float = 0.0, filter_s: float = 0.0) -> PmsmParameters:
    fitted = Switches(NEGATIVE_AT, POSITIVE_AT, (HOME_FROM, HOME_TO), bounce_s, 3, filter_s)
    return replace(LING, mechanism=Mechanism(switches=fitted))


def test_a_stop_that_is_hit_is_told() -> None:
    stops = EndStops(None, 1.0, 100.0, 0.2)
    bench = MotionBench(
        Mode.PROFILE_VELOCITY, motor=replace(LING, mechanism=Mechanism(load=PlacedLoad(stops=stops)))
    )
    assert bench.read(MACHINE, "I", STOPPED) == 0
    bench.profile(10.0, 500.0, 500.0)
    bench.speed(10.0)
    bench.wait_until(lambda: bench.read(MACHINE, "I", STOPPED) == 1, 400)
    assert bench.turns == pytest.approx(1.0, abs=0.02)
    assert bench.read(MACHINE, "i", STOP_SPEED) / 1000 == pytest.approx(10.0 * math.tau, rel=0.05)
    bench.wait_ms(500)
    assert 1.0 < bench.turns < 1.0 + LING.torque_max_nm / 100.0 / math.tau + 0.001, "it leans on the stop"
    assert bench.statusword & LIMITED


def test_without_stops_nothing_is_told_of_them() -> None:
    bench = MotionBench(Mode.PROFILE_VELOCITY)
    assert bench.servo.dictionary.get(MACHINE, STOPPED) is None


def test_switches_of_the_motor_file_are_fitted_from_power_on() -> None:
    bench = MotionBench(Mode.PROFILE_VELOCITY, motor=switched())
    assert bench.read(MACHINE, "B", SWITCHES) == 0b111
    places = [bench.read(MACHINE, "i", sub) / COUNTS for sub in range(3, 7)]
    assert places == pytest.approx([NEGATIVE_AT, POSITIVE_AT, HOME_FROM, HOME_TO], abs=1 / COUNTS)
    assert bench.inputs == 0b100
    bench.profile(10.0, 500.0, 500.0)
    bench.speed(10.0)
    bench.wait_until(lambda: bench.inputs == 0b010, 400)
    bench.wait_ms(200)
    assert POSITIVE_AT < bench.turns < POSITIVE_AT + 0.5, "the limit switch stops it"


def test_a_switch_that_bounces_is_seen_to_change() -> None:
    """On the way over the home switch at 2 turns/s, looked at every inner period."""
    changes = {}
    for name, motor in (
        ("clean", switched()),
        ("bounces", switched(0.003)),
        ("filter", switched(0.003, 0.003)),
    ):
        bench = MotionBench(Mode.PROFILE_VELOCITY, motor=motor)
        bench.profile(10.0, 500.0, 500.0)
        bench.speed(2.0)
        seen = []
        for _ in range(4800):
            bench.wait_ms(0.0625)
            seen.append(bench.inputs)
        changes[name] = sum(after != before for before, after in pairwise(seen))
        assert seen[0] == 0b100
        assert seen[-1] == 0
    assert changes["clean"] == changes["filter"] == 1
    assert 3 <= changes["bounces"] <= 7


@pytest.mark.parametrize("method", [17, 18, 19, 20, 23, 26])
def test_a_home_over_a_bouncing_switch_is_elsewhere(method: int) -> None:
    """The clean one to the count. A filter of the drive's inputs makes it late, by its own time, the
    bounces' and the drive's period, at the slow speed of 2 turns/s."""
    found = {}
    for name, motor in (
        ("clean", switched()),
        ("bounces", switched(0.01)),
        ("filter", switched(0.003, 0.003)),
    ):
        bench = MotionBench(Mode.HOMING, motor=motor)
        prepare(bench, method)
        home(bench)
        assert bench.statusword & MODE_BITS == DONE
        assert bench.read(Object.POSITION_ACTUAL_VALUE, "i") != 0
        found[name] = abs(zero_count(bench) - home_of(method)) / COUNTS
    assert found["clean"] == 0.0
    assert found["bounces"] < 0.011 * 2.0
    assert 0.003 * 2.0 < found["filter"] < (0.003 + 0.003 + 0.001) * 2.0


@pytest.mark.parametrize("bounce_s", [0.0, 2e-3])
@pytest.mark.parametrize(("way", "seen"), [(1, 0b01), (-1, 0b10)])
def test_swapped_limit_switches_are_seen_at_each_others_inputs(way: int, seen: int, bounce_s: float) -> None:
    """The drive asks the input of the way that it goes: it passes the end, and cannot come back."""
    fitted = Switches(-1.0, 1.0, None, bounce_s, swapped=True)
    bench = MotionBench(Mode.PROFILE_VELOCITY, motor=replace(LING, mechanism=Mechanism(switches=fitted)))
    bench.profile(4.0, 200.0, 200.0)
    bench.speed(way * 4.0)
    bench.wait_until(lambda: way * bench.turns > 1.2, 2000)
    assert bench.inputs & 0b11 == seen
    assert not bench.statusword & LIMITED
    bench.speed(-way * 4.0)
    bench.wait_ms(300)
    assert bench.statusword & LIMITED
    assert way * bench.turns > 1.2


def test_a_home_switch_is_not_swapped() -> None:
    fitted = Switches(None, 1.0, (0.2, 0.5), swapped=True)
    bench = MotionBench(Mode.PROFILE_VELOCITY, motor=replace(LING, mechanism=Mechanism(switches=fitted)))
    assert bench.read(MACHINE, "B", SWITCHES) == 0b110
    bench.profile(1.0, 200.0, 200.0)
    bench.speed(1.0)
    bench.wait_until(lambda: bench.turns > 0.35, 2000)
    assert bench.inputs & 0b111 == 0b100
    bench.wait_until(lambda: bench.turns > 1.1, 2000)
    assert bench.inputs & 0b111 == 0b001
