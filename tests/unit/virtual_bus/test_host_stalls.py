"""A host that is late: when a stall strikes, how long it lasts, and that a replay repeats it."""

import tomllib
from typing import Any

import pytest
from scipy import stats

from servobench.drivers.errors import MISSING, BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant
from servobench.virtual_bus.faults.fates import RecordedFaults
from servobench.virtual_bus.faults.fault_log import FaultLog, entry_line, read_line
from servobench.virtual_bus.faults.fault_plan import FaultPlan, load_fault_plan
from servobench.virtual_bus.faults.kinds.host_stall import HostStall
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.hosting.injection import Faults, Injection, refuse_misplaced

ZERO = Instant(7 * NS_PER_S)


def seconds(value: float) -> Duration:
    return Duration(round(value * NS_PER_S))


def stall(least_us: float, most_us: float | None = None, **occasion: Any) -> HostStall:
    if most_us is None:
        return HostStall(**occasion, late_us=least_us)
    return HostStall(**occasion, late_min_us=least_us, late_max_us=most_us)


class Host:
    """It should act each millisecond from the plan's time zero on; catches up after a stall."""

    def __init__(self, faults: Faults, seed: int = 3) -> None:
        self.log = FaultLog()
        self.injection = Injection(faults, seed, self.log)
        self.injection.start(ZERO)

    def late_us(self, cycles: int, since: int = 0) -> list[float]:
        """Its lateness at each tick."""
        return [
            self.injection.host_stall(Instant(ZERO + n * NS_PER_MS)) / NS_PER_US
            for n in range(since, since + cycles)
        ]


def late_us(*stalls: HostStall, cycles: int = 50, seed: int = 3) -> list[float]:
    return Host(FaultPlan(host_stalls=stalls), seed).late_us(cycles)


def test_once_at_the_first_action_from_its_instant_on() -> None:
    late = late_us(stall(3400, at_s=0.0105))
    assert [(n, value) for n, value in enumerate(late) if value] == [(11, 3400)]


def test_regularly_within_a_window() -> None:
    late = late_us(stall(500, every_s=0.004, from_s=0.01, until_s=0.03))
    assert [(n, value) for n, value in enumerate(late) if value] == [(n, 500) for n in (14, 18, 22, 26)]


def test_drawn_evenly_at_each_action() -> None:
    late = late_us(stall(0, 500, every_s=0.001), cycles=5000)[1:]
    assert stats.kstest(late, "uniform", args=(0, 500)).pvalue > 0.01


def test_by_chance_as_often_as_said() -> None:
    late = late_us(stall(10, probability_per_s=0.6), cycles=200_000)
    low, high = stats.poisson.interval(0.99, 200 * 0.9163)
    assert low < sum(value > 0 for value in late) < high


def test_strikes_during_a_stall_count_once_and_tables_add_up() -> None:
    host = Host(FaultPlan(host_stalls=(stall(200, every_s=0.001), stall(50, at_s=0.02))))
    assert host.late_us(3) == [0, 200, 200]
    assert host.late_us(2, since=20) == [250, 200], "17 ms later: one stall of the first table"


def test_nothing_strikes_outside_of_the_plan() -> None:
    injection = Injection(FaultPlan(host_stalls=(stall(200, every_s=0.001),)), 1)
    assert injection.host_stall(ZERO) == 0
    injection.start(ZERO)
    assert injection.host_stall(Instant(ZERO + NS_PER_MS)) == 200 * NS_PER_US
    injection.stop()
    assert injection.host_stall(Instant(ZERO + 9 * NS_PER_MS)) == 0
    assert Injection(FaultPlan(), 1).host_stall(ZERO) == 0


def test_each_table_has_a_stream_of_its_own_and_faults_of_frames_do_not_disturb_it() -> None:
    jitter, rare = stall(0, 400, every_s=0.001), stall(1000, 9000, probability_per_s=0.9)
    alone = late_us(jitter, cycles=3000)
    plan = FaultPlan((Loss(probability=0.5),), host_stalls=(jitter, rare))
    both = Host(plan).late_us(3000)
    assert sum(one != other for one, other in zip(alone, both, strict=True)) < 20
    assert late_us(jitter, cycles=3000, seed=4) != alone
    assert late_us(jitter, cycles=3000) == alone


def test_a_replay_stalls_the_same_actions() -> None:
    plan = FaultPlan(host_stalls=(stall(0, 400, every_s=0.003), stall(5000, at_s=0.02)))
    first = Host(plan)
    late = first.late_us(40)
    lines = [entry_line(entry) for entry in first.log.entries()]
    assert lines[0].startswith('{"kind":"host_stall","at_ns":3000000,"n":3,"late_ns":')
    recorded = RecordedFaults(tuple(read_line(line, "f", n) for n, line in enumerate(lines, start=1)))
    again = Host(recorded, seed=99)
    assert again.late_us(40) == late
    assert [entry_line(entry) for entry in again.log.entries()] == lines


TABLES = """
[[host_stall]]
at_s = 1.5
late_us = 3400
[[host_stall]]
every_s = 0.001
from_s = 1
until_s = 2
late_min_us = 0
late_max_us = 120
[[host_stall]]
probability_per_s = 0.5
late_us = 700
"""


def load(text: str) -> FaultPlan:

    return load_fault_plan(tomllib.loads(text), "plan.toml")


def test_tables_are_read_and_survive_being_written() -> None:
    plan = load(TABLES)
    assert plan.host_stalls == (
        stall(3400, at_s=1.5),
        stall(0, 120, every_s=0.001, from_s=1, until_s=2),
        stall(700, probability_per_s=0.5),
    )
    assert load_fault_plan(plan.as_tables(), "written") == plan


@pytest.mark.parametrize(
    ("table", "key", "value", "expected"),
    [
        ("late_us = 5", "probability_per_s", MISSING, "or at_s or every_s instead"),
        ("at_s = 1", "late_us", MISSING, "a time, or late_min_us and late_max_us"),
        ("at_s = 1\nlate_us = -1", "late_us", -1, "a time from 0 to 10000000 us"),
        ("at_s = 1\nlate_min_us = 5\nlate_max_us = 4", "late_max_us", 4, "from late_min_us = 5"),
        ("at_s = 1\nevery_s = 1\nlate_us = 5", "every_s", 1, "no at_s beside"),
        ("every_s = 1\nprobability_per_s = 0.5\nlate_us = 5", "probability_per_s", 0.5, "no every_s beside"),
        ("every_s = 1e-6\nlate_us = 5", "every_s", 1e-6, "a time from 0.0001 s"),
        ("every_s = 1\nfrom_s = 2\nuntil_s = 1\nlate_us = 5", "until_s", 1, "after from_s = 2"),
        ("at_s = 1\nlate_us = 5\nnodes = [1]", "nodes", None, "no such key"),
        ("at_s = 1\nlate_us = 5\nside = 'host'", "side", None, "no such key"),
        ("at_s = 1\nlate_ms = 5", "late_ms", 5, "late_us"),
    ],
)
def test_what_cannot_be_used_is_refused_with_reasons(
    table: str, key: str, value: object, expected: str
) -> None:
    with pytest.raises(BadInput) as caught:
        load(f"[[host_stall]]\n{table}")
    assert caught.value.key == f"host_stall[0].{key}"
    assert value is None or caught.value.value == value
    assert expected in caught.value.expected


@pytest.mark.parametrize("side", ["host", "drive"])
def test_a_host_in_real_time_is_late_by_itself(side: Any) -> None:
    plan = FaultPlan(host_stalls=(stall(200, at_s=1),))
    with pytest.raises(BadInput) as caught:
        refuse_misplaced(plan, side, "the bus hub:x")
    assert (caught.value.key, caught.value.remedy) == ("host_stall", "run it with --bus simulated")
