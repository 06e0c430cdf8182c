"""What a certificate presumes, at its limits: counted by hand on rows of one axis."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_US
from servobench.hil.loop.cycle_record import COMMAND_FATES, NOTHING
from servobench.hil.loop.samples import CommandFate
from servobench.hil.reviewing.certificate_meter import PremisesMeter
from servobench.hil.reviewing.network_meter import AxisNetworkMeter
from servobench.hil.rows.recording_plan import AxisPlan, CertifiedPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows

PERIOD_US = 1_000
LIMIT_ACTIVE = 1 << 11
AXIS = AxisPlan("axis1", 1e4, torque_max_nm=2.0)
CERTIFIED = CertifiedPlan(PERIOD_US, delay_us=800.0, losses_together=2)
ACTING, LOST = (COMMAND_FATES.index(fate) for fate in (CommandFate.ACTING, CommandFate.LOST))


def rows(count: int, least_us: float = 500.0, most_us: float = 500.0, lost: tuple[int, ...] = ()) -> Rows:
    """Every command acts so long after its sample; ``lost``: cycles without a reading."""
    made = np.zeros(count, ROW_DTYPE)
    sampled = np.arange(count) * PERIOD_US * NS_PER_US
    made["axis"], made["certain"], made["due_at"] = 3, 1, sampled
    made["sampled_at"] = made["sync_on_bus_at"] = sampled
    made["sequence"] = np.arange(1, count + 1)
    made["received_at"] = made["command_handed_at"] = sampled + 100 * NS_PER_US
    made["command_on_bus_at"] = sampled + 200 * NS_PER_US
    made["command_acts_after"] = sampled + round(least_us * NS_PER_US)
    made["command_acts_by"] = sampled + round(most_us * NS_PER_US)
    made["command_fate"], made["clock_error_ns"] = ACTING, NS_PER_US * PERIOD_US
    made["fate"][list(lost)] = 1
    return made


def judged(run: Rows, **certified: Any) -> tuple[list[str], list[str]]:
    """Premises left and not known; the same in whatever chunks the rows come."""
    results = []
    for size in (run.size, 1, 3):
        network = AxisNetworkMeter(PERIOD_US)
        meter = PremisesMeter(AXIS, replace(CERTIFIED, **certified), network)
        for at in range(0, run.size, size):
            network.add(run[at : at + size])
            meter.add(run[at : at + size])
        results.append((list(meter.left()), list(meter.unknown())))
    assert results[1:] == results[:1] * 2
    return results[0]


@pytest.mark.parametrize(
    ("least_us", "most_us", "left", "unknown"),
    [
        (800.0, 800.0, [], []),
        (800.1, 800.1, ["delay: 800.1 us from sample to actuator, made for 800 us"], []),
        (799.9, 800.0, [], []),
        (
            700.0,
            800.1,
            [],
            [
                "delay: 700.0 to 800.1 us from sample to actuator, made for 800 us "
                '(loop.command_readback = "event" tells it)'
            ],
        ),
        (800.1, 900.0, ["delay: 800.1 us from sample to actuator, made for 800 us"], []),
    ],
)
def test_a_delay_is_left_by_its_least_and_not_known_by_its_most(
    least_us: float, most_us: float, left: list[str], unknown: list[str]
) -> None:
    assert judged(rows(5, least_us, most_us)) == (left, unknown)
    assert judged(rows(5, least_us, most_us), delay_us=None) == ([], [])


@pytest.mark.parametrize(
    ("most_us", "left", "known"),
    [
        (790.0, [], True),
        (789.9, ["constant delay: 789.9 us from sample to actuator, certified for 800 us alone"], True),
        (810.0, [], True),
        (810.1, [], False),
    ],
)
def test_a_constant_delay_is_kept_as_near_as_two_clocks_tell(
    most_us: float, left: list[str], known: bool
) -> None:
    found = judged(rows(5, min(most_us, 790.0), most_us), samples_alone=True)
    assert (found[0], not found[1]) == (left, known)
    assert judged(rows(5, min(most_us, 790.0), most_us), samples_alone=True, delay_us=None) == ([], [])


def test_commands_that_are_lost_count_only_where_every_one_has_to_arrive() -> None:
    run = rows(6)
    run["command_fate"][2:4] = LOST
    assert judged(run, losses_together=2) == ([], [])
    assert judged(run, samples_alone=True, losses_together=2, delay_us=500.0) == (
        ["commands: 2 lost, certified where every one arrives"], []
    )  # fmt: skip


@pytest.mark.parametrize(("lost", "left"), [((1, 2, 4), []), ((0, 1, 2, 4), ["3"]), ((6, 7, 8, 9), ["4"])])
def test_losses_in_a_row_are_at_most_those_it_is_made_for(lost: tuple[int, ...], left: list[str]) -> None:
    """Also those before the first reading, and behind the last."""
    expected = [
        f"losses: {count} in a row, readings and commands together, made for at most 2" for count in left
    ]
    assert judged(rows(10, lost=lost)) == (expected, [])
    assert judged(rows(10, lost=lost), losses_together=None) == ([], [])


@pytest.mark.parametrize(
    ("lost", "age_us"), [((), 1500.0), ((3,), 2500.0), ((3, 4), 3500.0), ((0,), 2500.0), ((5, 8, 9), 2500.0)]
)
def test_a_sample_acts_until_the_next_one_does(lost: tuple[int, ...], age_us: float) -> None:
    """Its age: a period, one more for each loss behind it, and the delay of 500 us."""
    run = rows(10, lost=lost)
    assert judged(run, age_us=age_us) == ([], [])
    assert judged(run, age_us=age_us - 0.1) == (
        [f"age: a sample that acts for {age_us:.1f} us, made for at most {age_us - 0.1:g} us"], []
    )  # fmt: skip


def test_an_age_beyond_its_limit_is_not_told_beside_what_makes_it() -> None:
    assert judged(rows(10, lost=(3, 4, 5)), age_us=1.0)[0] == [
        "losses: 3 in a row, readings and commands together, made for at most 2"
    ]
    late = ["delay: 900.0 us from sample to actuator, made for 800 us"]
    assert judged(rows(10, 900.0, 900.0), age_us=1.0)[0] == late


def test_without_a_reading_or_a_command_that_acts_nothing_is_measured() -> None:
    nothing = ["delay: from sample to actuator nothing was measured"]
    assert judged(rows(2, lost=(0, 1))) == ([], nothing)
    still = rows(4)
    still["command_fate"] = NOTHING
    assert judged(still, samples_alone=True, age_us=1.0) == ([], nothing)


def test_premises_of_bench_and_drive_come_first() -> None:
    run = rows(4, 900.0, 900.0)
    left, unknown = judged(run, left=("inertia",), unknown=("bandwidth",))
    assert (left[0], unknown) == ("inertia", ["bandwidth"])
    assert len(left) == 2


@pytest.mark.parametrize(
    ("commands", "status", "step_max", "saturated"),
    [
        ([1.9, -1.9, 0.0], 0, None, 0),
        ([2.0, -2.0, 2.5], 0, None, 3),
        ([2.0 * (1.0 - 1e-10), 0.0, 0.0], 0, None, 1),
        ([float("nan"), 2.0, float("nan")], 0, None, 1),
        ([0.0, 0.0, 0.0], LIMIT_ACTIVE, None, 3),
        ([0.0, 0.0, 0.0], NOTHING, None, 0),
        ([0.5, 0.0, -0.4], 0, 0.5, 2),  # the first step is that from 0
        ([0.4, 0.0, -0.4], 0, 0.5, 0),
        ([2.0, float("nan"), 2.0], LIMIT_ACTIVE, 2.0, 6),
    ],
)
def test_commands_at_a_limit_count_where_they_are_held_against_the_certificate(
    commands: list[float], status: int, step_max: float | None, saturated: int
) -> None:
    run = rows(3)
    run["command_torque_nm"], run["statusword"] = commands, status
    meter = PremisesMeter(AXIS, replace(CERTIFIED, torque_step_max_nm=step_max), AxisNetworkMeter(PERIOD_US))
    meter.count_limited(run, held=False)
    assert (meter.saturated, list(meter.left())) == (0, [])
    meter = PremisesMeter(AXIS, replace(CERTIFIED, torque_step_max_nm=step_max), AxisNetworkMeter(PERIOD_US))
    meter.count_limited(run, held=True)
    told = [f"saturation: {saturated} commands at a limit after a load step"] if saturated else []
    assert (meter.saturated, list(meter.left())) == (saturated, told)


def test_a_step_between_two_stretches_counts_and_without_limits_none_does() -> None:
    run = rows(2)
    run["command_torque_nm"] = [1.0, 9.0]
    free = PremisesMeter(replace(AXIS, torque_max_nm=None), CERTIFIED, AxisNetworkMeter(PERIOD_US))
    free.count_limited(run, held=True)
    assert free.saturated == 0
    meter = PremisesMeter(AXIS, replace(CERTIFIED, torque_step_max_nm=1.0), AxisNetworkMeter(PERIOD_US))
    meter.count_limited(run[:1], held=False)
    nothing = run[1:].copy()
    nothing["command_torque_nm"] = np.nan
    meter.count_limited(nothing, held=False)
    after = run[1:].copy()
    after["command_torque_nm"] = 1.9
    meter.count_limited(after, held=True)
    assert meter.saturated == 0
    after["command_torque_nm"] = 0.8
    meter.count_limited(after, held=True)
    assert meter.saturated == 1


def uneven(late_us: dict[int, float], acts_with: bool = False, **more: Any) -> Rows:
    """SYNCs of 1 ms, each late by so much; ``acts_with``: commands act 800 us after the one that follows."""
    made = rows(6, **more)
    late = np.array([round(late_us.get(row, 0.0) * NS_PER_US) for row in range(6)])
    for name in ("sampled_at", "sync_on_bus_at", "command_acts_after", "command_acts_by"):
        made[name] += late
    if acts_with:
        for name in ("command_acts_after", "command_acts_by"):
            made[name] += PERIOD_US * NS_PER_US + np.append(late[1:], 0) - late
    return made


EVEN, TO_40 = "a constant period of 1000 us", "960 to 1040 us"


@pytest.mark.parametrize(
    ("within_us", "late_us", "seen"),
    [
        (0.0, {2: 1.0}, ""),
        (0.0, {2: 1.1}, f"998.9 to 1001.1 us from one to the next, made for {EVEN}"),
        (40.0, {2: 41.0}, ""),
        (40.0, {2: 41.1}, f"958.9 to 1041.1 us from one to the next, made for {TO_40}"),
        (40.0, {2: 21.0, 3: -21.0}, f"958.0 to 1021.0 us from one to the next, made for {TO_40}"),
        (40.0, {0: 60.0}, f"940.0 to 1000.0 us from one to the next, made for {TO_40}"),
        (40.0, {5: 60.0}, f"1000.0 to 1060.0 us from one to the next, made for {TO_40}"),
    ],
)
@pytest.mark.parametrize("lost", [(), (2,), (0, 5)])
def test_distances_of_syncs_are_those_it_is_made_for_also_where_readings_are_lost(
    within_us: float, late_us: dict[int, float], seen: str, lost: tuple[int, ...]
) -> None:
    left = [f"SYNC: {seen}"] if seen else []
    assert judged(uneven(late_us, lost=lost), sync_within_us=within_us) == (left, [])


@pytest.mark.parametrize(("error_us", "left"), [(0, True), (10, True), (14, True), (15, False), (200, False)])
def test_a_drive_that_samples_unevenly_leaves_the_premise_as_far_as_its_instants_are_known(
    error_us: int, left: bool
) -> None:
    run = uneven({})
    run["sampled_at"][3] += 70 * NS_PER_US
    run["sampled_at_error_ns"] = error_us * NS_PER_US
    found, _ = judged(run, sync_within_us=40.0)
    seen = 70 - 2 * error_us
    text = f"SYNC: {1000 - seen}.0 to {1000 + seen}.0 us from one to the next, made for {TO_40}"
    assert found == ([text] if left else [])


def test_a_distance_over_cycles_without_a_sync_counts_as_so_many_equal_ones() -> None:
    run = uneven({3: 81.0}, lost=(1, 2))
    run["sync_on_bus_at"][[1, 2]] = NOTHING
    run = run[:4]
    assert judged(run, sync_within_us=27.0) == ([], [])
    (text,), _ = judged(run, sync_within_us=26.6)
    assert text == "SYNC: 1027.0 to 1027.0 us from one to the next, made for 973.4 to 1026.6 us"


def test_a_reading_that_may_answer_another_sync_says_nothing_of_its_instant() -> None:
    run = uneven({})
    run["sampled_at"][2] += 500 * NS_PER_US
    run["certain"][2] = 0
    assert judged(run) == ([], [])


@pytest.mark.parametrize("late_us", [{2: 39.0}, {1: 20.0, 2: -19.0, 5: 20.0}, {}])
@pytest.mark.parametrize("lost", [(), (2, 3)])
def test_a_delay_is_constant_behind_the_sync_at_which_commands_act(
    late_us: dict[int, float], lost: tuple[int, ...]
) -> None:
    made_for: dict[str, Any] = {"samples_alone": True, "delay_us": 1840.0, "sync_within_us": 40.0}
    run = uneven(late_us, True, least_us=800.0, most_us=800.0, lost=lost)
    assert judged(run, **made_for) == ([], [])
    for name in ("command_acts_after", "command_acts_by"):
        run[name][4] += 11 * NS_PER_US
    (text,), _ = judged(run, **made_for)
    assert text == "constant delay: 1811.0 us from sample to actuator, certified for 1800 us alone"


def test_a_delay_that_is_constant_behind_the_sample_is_none_behind_an_uneven_sync() -> None:
    run = uneven({3: 30.0}, least_us=1800.0, most_us=1800.0)
    (text,), _ = judged(run, samples_alone=True, delay_us=1840.0, sync_within_us=40.0)
    assert text.startswith("constant delay: 1770.0 us from sample to actuator")
