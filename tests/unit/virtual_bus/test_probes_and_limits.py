"""Touch probe, torque limits of either sign and the relative option of moves (CiA 402-2), by frames."""

import math
from dataclasses import replace
from typing import Final

import pytest

from servobench.drivers.cia402.profile import Mode, State
from servobench.virtual_bus.drive.machine import MACHINE
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import COUNTS, INDEX, NEW_SET_POINT, RELATIVE, MotionBench

FUNCTION, STATUS, SOURCE = 0x60B8, 0x60B9, 0x60D0
POSITIVE, NEGATIVE = (0x60BA, 0x60BC), (0x60BB, 0x60BD)
"""Of probe 1 and 2."""
ENABLED, EACH, ZERO_IMPULSE, BY_SOURCE, RISING, FALLING = 0x01, 0x02, 0x04, 0x08, 0x10, 0x20
INPUTS: Final = 11
"""Sub-index of the simulated machine."""
INVALID_VALUE: Final = 0x0609_0030


def turning(turns_s: float = 2.0) -> MotionBench:
    bench = MotionBench(Mode.PROFILE_VELOCITY)
    bench.speed(turns_s)
    bench.wait_ms(1500)
    return bench


def probed(bench: MotionBench, index: int) -> float:
    """Turns."""
    return bench.read(index, "i") / COUNTS


def status(bench: MotionBench) -> int:
    return bench.read(STATUS, "H")


@pytest.mark.parametrize("probe", [0, 1])
def test_an_input_captures_the_position_at_each_edge_that_is_asked_for(probe: int) -> None:
    """CiA 402-2, touch probe functionality: 60B8h bits 0, 4 and 5 (8, 12 and 13), 60B9h, 60BAh to 60BDh."""
    bench = turning()
    bench.set(FUNCTION, "H", (ENABLED | RISING) << 8 * probe)
    assert status(bench) == 1 << 8 * probe
    bench.set(MACHINE, "B", 1 << (1 - probe), INPUTS)
    assert status(bench) == 1 << 8 * probe, "that is the other probe's input"
    before = bench.turns
    bench.set(MACHINE, "B", 3, INPUTS)
    bench.wait_ms(5)
    assert probed(bench, POSITIVE[probe]) == before != bench.turns
    assert status(bench) == 3 << 8 * probe
    bench.set(MACHINE, "B", 0, INPUTS)
    assert status(bench) == 3 << 8 * probe
    assert probed(bench, NEGATIVE[probe]) == 0.0, "falling edges are not asked for"
    bench.set(FUNCTION, "H", (ENABLED | RISING | FALLING) << 8 * probe)
    bench.set(MACHINE, "B", 3, INPUTS)
    before = bench.turns
    bench.set(MACHINE, "B", 0, INPUTS)
    bench.wait_ms(5)
    assert probed(bench, NEGATIVE[probe]) == before != bench.turns
    assert status(bench) == 7 << 8 * probe


@pytest.mark.parametrize("each", [False, True])
def test_the_first_event_is_kept_unless_each_is_asked_for(each: bool) -> None:
    """60B8h bit 1: 0 trigger first event, 1 continuous. Bit 0 cleared clears the status."""
    bench = turning()
    bench.set(FUNCTION, "H", ENABLED | RISING | (EACH if each else 0))
    places = []
    for _ in range(2):
        bench.set(MACHINE, "B", 1, INPUTS)
        bench.set(MACHINE, "B", 0, INPUTS)
        places.append(probed(bench, POSITIVE[0]))
        bench.wait_ms(50)
    assert (places[1] > places[0]) is each
    bench.set(FUNCTION, "H", RISING)
    assert status(bench) == 0
    bench.set(FUNCTION, "H", ENABLED | RISING)
    assert status(bench) == 1, "switched on again it waits again"
    bench.set(MACHINE, "B", 1, INPUTS)
    assert probed(bench, POSITIVE[0]) > places[1]
    bench.set(FUNCTION, "H", ENABLED | FALLING)
    assert status(bench) == 1, "an edge that is no longer asked for is not stored"


@pytest.mark.parametrize("turns_s", [2.0, -2.0])
def test_the_zero_impulse_is_captured_at_its_count(turns_s: float) -> None:
    """60B8h bits 2 and 3: 01 is the zero impulse signal of the position encoder."""
    bench = turning(turns_s)
    bench.set(MACHINE, "I", COUNTS // 4, INDEX)
    bench.set(FUNCTION, "H", ENABLED | ZERO_IMPULSE | RISING)
    began = bench.turns
    bench.wait_ms(1200)
    assert status(bench) == 3
    first = math.ceil(began - 0.25) + 0.25 if turns_s > 0 else math.floor(began - 0.25) + 0.25
    assert probed(bench, POSITIVE[0]) == first
    bench.wait_ms(1200)
    assert probed(bench, POSITIVE[0]) == first
    bench.set(FUNCTION, "H", ENABLED | ZERO_IMPULSE | RISING | EACH)
    bench.wait_ms(1200)
    last = probed(bench, POSITIVE[0])
    assert abs(last - bench.turns) < 1.0
    assert (last - 0.25).is_integer()


def test_a_probe_that_is_off_stores_nothing() -> None:
    bench = turning()
    bench.set(FUNCTION, "H", RISING)
    bench.set(MACHINE, "B", 1, INPUTS)
    assert status(bench) == 0
    assert probed(bench, POSITIVE[0]) == 0.0


@pytest.mark.parametrize("word", [0x0C, 0x0C00, 0x0C08])
def test_a_reserved_source_is_refused(word: int) -> None:
    assert MotionBench(Mode.PROFILE_VELOCITY).write(FUNCTION, "H", word) == INVALID_VALUE


@pytest.mark.parametrize("probe", [0, 1])
@pytest.mark.parametrize("source", [1, 2])
def test_60d0h_says_whose_input_a_probe_looks_at(probe: int, source: int) -> None:
    """60B8h bits 2 and 3: 10 is the source of 60D0h, 1 the input of probe 1 and 2 that of probe 2."""
    bench = turning()
    assert [bench.read(SOURCE, "h", sub) for sub in (1, 2)] == [1, 2]
    bench.set(SOURCE, "h", source, probe + 1)
    bench.set(FUNCTION, "H", (ENABLED | BY_SOURCE | RISING) << 8 * probe)
    bench.set(MACHINE, "B", 1 << (2 - source), INPUTS)
    assert status(bench) == 1 << 8 * probe
    before = bench.turns
    bench.set(MACHINE, "B", 3, INPUTS)
    bench.wait_ms(5)
    assert status(bench) == 3 << 8 * probe
    assert probed(bench, POSITIVE[probe]) == before != bench.turns


@pytest.mark.parametrize("source", [5, 6])
def test_60d0h_can_name_the_zero_impulse(source: int) -> None:
    bench = turning()
    bench.set(MACHINE, "I", COUNTS // 4, INDEX)
    bench.set(SOURCE, "h", source, 1)
    bench.set(FUNCTION, "H", ENABLED | BY_SOURCE | RISING)
    began = bench.turns
    bench.set(MACHINE, "B", 3, INPUTS)
    assert status(bench) == 1
    bench.wait_ms(1200)
    assert probed(bench, POSITIVE[0]) == math.ceil(began - 0.25) + 0.25


@pytest.mark.parametrize("source", [0, 3, 4, 7, -1])
def test_a_source_that_the_drive_lacks_is_refused(source: int) -> None:
    assert MotionBench(Mode.PROFILE_VELOCITY).write(SOURCE, "h", source, 1) == INVALID_VALUE


def test_a_reset_of_the_node_switches_the_probe_off() -> None:
    bench = turning()
    bench.set(FUNCTION, "H", ENABLED | RISING)
    bench.set(MACHINE, "B", 1, INPUTS)
    assert status(bench) == 3
    bench.nmt(0x81)
    bench.wait_ms(300)
    assert status(bench) == 0
    bench.set(FUNCTION, "H", ENABLED | RISING)
    assert status(bench) == 1


# ---- torque limits ----------------------------------------------------------------------------------------

UP, DOWN, MOST = 0x60E0, 0x60E1, 0x6072
FREE = replace(LING, viscous_friction_nm_s=0.0)


@pytest.mark.parametrize(
    ("limits", "made"),
    [
        ({}, (800, -800)),
        ({UP: 300}, (300, -800)),
        ({DOWN: 200}, (800, -200)),
        ({UP: 300, DOWN: 200, MOST: 250}, (250, -200)),
        ({UP: 0}, (0, -800)),
    ],
)
def test_either_sign_of_the_torque_has_its_limit(limits: dict[int, int], made: tuple[int, int]) -> None:
    """CiA 402-2: 60E0h positive and 60E1h negative torque limit value, and 6072h bounds both."""
    bench = MotionBench(Mode.CYCLIC_SYNCHRONOUS_TORQUE, motor=FREE)
    for index, value in limits.items():
        bench.set(index, "H", value)
    told = []
    for target in (800, -800):
        bench.set(0x6071, "h", target)
        bench.wait_ms(5)
        told.append((bench.read(0x6074, "h"), bench.read(0x6077, "h")))
        bench.set(0x6071, "h", 0)
        bench.wait_ms(5)
    for (demand, actual), wanted in zip(told, made, strict=True):
        assert demand == wanted
        assert actual == pytest.approx(wanted, abs=10)


def test_a_speed_loop_accelerates_and_brakes_within_them() -> None:
    bench = MotionBench(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, motor=FREE)
    bench.set(UP, "H", 100)
    bench.set(DOWN, "H", 200)
    bench.speed(20.0)
    upwards = max(bench.watch(200, lambda: bench.read(0x6077, "h")))
    bench.wait_ms(1000)
    bench.speed(0.0)
    downwards = min(bench.watch(200, lambda: bench.read(0x6077, "h")))
    assert upwards == pytest.approx(100, abs=5)
    assert downwards == pytest.approx(-200, abs=5)
    assert bench.state is State.OPERATION_ENABLED


# ---- relative moves ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("option", "origin"), [(0, "target"), (1, "demand"), (2, "actual")])
def test_a_relative_move_counts_from_what_60f2h_says(option: int, origin: str) -> None:
    """CiA 402-2, positioning option code, bits 0 and 1: from the preceding target, from the position demand
    value, or from the position actual value."""
    bench = MotionBench(Mode.PROFILE_POSITION)
    bench.set(0x60F2, "H", option)
    bench.profile(2.0, 20.0, 20.0)
    bench.target(10.0)
    bench.wait_ms(1500)
    bench.set(0x607A, "i", COUNTS)
    places = {"target": 10.0, "demand": bench.read(0x6062, "i") / COUNTS, "actual": bench.turns}
    bench.control(0x0F | NEW_SET_POINT | RELATIVE | 0x20)
    bench.control(0x0F)
    bench.until_reached(10_000)
    assert bench.turns == pytest.approx(places[origin] + 1.0, abs=2e-3 if option == 0 else 0.01)


@pytest.mark.parametrize("option", [3, 4, 0x43, 0x100, 0xFFFF])
def test_an_option_that_the_drive_lacks_is_refused(option: int) -> None:
    assert MotionBench(Mode.PROFILE_POSITION).write(0x60F2, "H", option) == INVALID_VALUE
