"""Bus load from a bounded number of checkpoints."""

import pytest

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.core.native import CHECKPOINTS_MAX, BusLoad


def test_busy_spell_lies_at_the_end_of_its_interval() -> None:
    load = BusLoad()
    load.add(100, Instant(1_000))
    load.add(300, Instant(2_000))
    assert [load.busy_until(Instant(when)) for when in (0, 900, 950, 1_000)] == [0, 0, 50, 100]
    assert [load.busy_until(Instant(when)) for when in (1_700, 1_800, 2_000, 9_000)] == [100, 200, 400, 400]
    assert load.percent(Instant(950), Instant(1_750)) == pytest.approx(100 * 100 / 800)


def test_a_long_run_keeps_its_bound_and_its_accuracy() -> None:
    load = BusLoad()
    frames = 5 * CHECKPOINTS_MAX + 7
    for number in range(1, frames + 1):
        load.add(25, Instant(100 * number))
    end = Instant(100 * frames)
    assert load.busy_ns == 25 * frames
    assert load.percent(Instant(0), end) == pytest.approx(25.0, rel=1e-12)
    between_checkpoints = 8 * 25
    for when in range(0, end, 99_991):
        assert abs(load.busy_until(Instant(when)) - when / 4) <= between_checkpoints
