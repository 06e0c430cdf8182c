"""The lane of readings: true to the cycle, where the lane of the whole run has stretches."""

from pathlib import Path

from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.loop.cycle_record import FATE_MISSED
from tests.rrd_columns import lane
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.row_tools import plain_rows
from tests.unit.hil.test_telemetry import write_run


def test_each_cycle_without_a_reading_has_its_place_where_a_part_is_looked_into(tmp_path: Path) -> None:
    rows = plain_rows(20_000)
    rows["fate"][[700, 703, 704, 12_345]] = 1, 1, 2, FATE_MISSED
    path = write_run(plan_for(tmp_path), rows, events=())
    times, states = lane(path, "axis1 readings")
    assert (times[1:-1] // NS_PER_MS).tolist() == [700, 701, 703, 704, 705, 12_345, 12_346]
    told = ["-", "Lost", "-", "Lost", "Late", "-", "Missed", "-", "-"]
    assert [state for (state,) in states] == told
