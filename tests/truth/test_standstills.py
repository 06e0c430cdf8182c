"""Drives whose processes stand still for up to several periods, and what a run tells of them."""

from itertools import pairwise

import pytest

from servobench.drivers.timebase import NS_PER_US
from tests.truth.drawn import drawn_plan
from tests.truth.drawn_bench import PERIOD_US, DrawnPlan
from tests.truth.drawn_run import bench_config, judged
from tests.truth.standstills import Standstills, Waiting
from tests.truth.tapped_run import Surroundings, run_with_taps
from tests.truth.truth import passages

CYCLES = 300
LONGEST_US = 3 * PERIOD_US


def standing(waiting: Waiting) -> DrawnPlan:
    """Every 20 periods, for three at the most."""
    return DrawnPlan(1, standstills=Standstills(20 * PERIOD_US, LONGEST_US, waiting))


@pytest.mark.parametrize(
    ("waiting", "lost", "together", "late"),
    [
        (Waiting.QUEUE, False, True, True),
        (Waiting.NEWEST, True, False, True),
        (Waiting.OLDEST, True, False, True),
        (Waiting.ANSWERS, False, False, False),
    ],
)
def test_a_drive_that_stands_still_hears_late_or_never_or_answers_late(
    waiting: Waiting, lost: bool, together: bool, late: bool
) -> None:
    plan = standing(waiting)
    log = run_with_taps(bench_config(plan, CYCLES), Surroundings(standstills=plan.standstills)).log
    seen, heard = passages(log), log.drives[1].syncs
    first = seen.places[id(heard[0].frame)]
    assert (len(heard) < len(seen.handed) - first) is lost
    assert any(later.at == earlier.at for earlier, later in pairwise(heard)) is together
    by = [each.at - seen.on_bus[id(each.frame)] for each in heard]
    assert any(by) is late
    assert max(by) <= LONGEST_US * NS_PER_US
    took = max(
        seen.fetched[id(each.answers[0])][1] - each.at
        for each in heard
        if id(each.answers[0]) in seen.fetched
    )
    assert (took > PERIOD_US * NS_PER_US) is not late


@pytest.mark.parametrize("waiting", Waiting)
@pytest.mark.parametrize("stamps", [True, False])
def test_what_a_run_tells_of_a_drive_that_stands_still_is_what_happened(
    waiting: Waiting, stamps: bool
) -> None:
    plan = standing(waiting)
    plan.has_stamps = stamps
    verdict = judged(plan, CYCLES)
    assert verdict.wrong == {}, verdict.examples


@pytest.mark.parametrize(("seed", "cycles"), [(480849, 60), (480361, 250), (480586, 20), (482144, 1270)])
def test_a_reading_on_the_sync_behind_its_own_is_in_doubt(seed: int, cycles: int) -> None:
    """While calibrating, where one such moved the clock's map by a period and 1405 of 1500 rows were others',
    among stamps of 250 us: 27 of 3000; as the second of a SYNC, 2 us apart, and as a copy of one that put a
    question: one each."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples
