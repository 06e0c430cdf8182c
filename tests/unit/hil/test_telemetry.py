"""run.rrd, read back with Rerun's own reader."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Instant
from servobench.hil.loop.cycle_record import COMMAND_FATES, FATE_MISSED, FATE_SAMPLE, NOTHING
from servobench.hil.loop.samples import CommandFate
from servobench.hil.recording.telemetry import Telemetry
from servobench.hil.reviewing.envelope import BUCKETS
from servobench.hil.reviewing.histogram import round_width
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import AxisPlan, RecordingPlan, ReviewPlan
from servobench.hil.rows.records import Rows
from servobench.hil.rows.run_files import FORMAT
from servobench.hil.rows.side_rows import BeginEvent, IdentityEvent, RunEvent, StateEvent, TextEvent
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary import Summary, summarise
from tests.rrd_columns import columns, lane, numbers, view_ranges
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.row_tools import plain_rows, rows_of
from tests.unit.hil.synthetic_run import synthetic_records

CYCLES = 1_500
ORIGIN = 300 * NS_PER_MS
EVENTS: tuple[RunEvent, ...] = (
    TextEvent(Instant(ORIGIN - 7 * NS_PER_MS), "INFO", "set up"),
    StateEvent(Instant(ORIGIN - 5 * NS_PER_MS), "axis1 drive", "switched on"),
    BeginEvent(Instant(ORIGIN)),
    TextEvent(Instant(ORIGIN + NS_PER_MS), "WARN", "load"),
    StateEvent(Instant(ORIGIN + 2 * NS_PER_MS), "phase", "load step"),
)
Column = tuple[np.ndarray, list[list[object]]]


def write_run(plan: RecordingPlan, rows: Rows, events: tuple[RunEvent, ...] = EVENTS) -> Path:
    """A whole recording in two blocks."""
    assert plan.folder is not None
    path = plan.folder / "run.rrd"
    review = Review(plan.review)
    review.add(rows)
    telemetry = Telemetry(plan, "a-recording", rr.FileSink(path))
    telemetry.take_events(events)
    for block in np.array_split(rows, 2):
        telemetry.take_rows(block)
        telemetry.flush()
    outcome = whole_outcome(review.figures().cycles)
    telemetry.finish(summarise(review.figures(), outcome, plan.review.limits, "", 1), review)
    return path


@pytest.fixture(scope="module")
def rows() -> Rows:
    return rows_of(synthetic_records(CYCLES, origin=ORIGIN))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, rows: Rows) -> Path:
    return write_run(plan_for(tmp_path_factory.mktemp("run")), rows)


RPM = 30 / np.pi


def test_speed_and_reference_are_those_of_the_records(recording: Path, rows: Rows) -> None:
    read = rows[rows["fate"] == FATE_SAMPLE]
    times, speed = numbers(recording, "/axis1/speed/measured")
    np.testing.assert_array_equal(times, read["due_at"] - ORIGIN)
    np.testing.assert_allclose(speed, read["velocity_rad_s"] * RPM)
    times, reference = numbers(recording, "/axis1/speed/reference")
    np.testing.assert_array_equal(times, rows["due_at"] - ORIGIN)
    np.testing.assert_allclose(reference, rows["reference_rad_s"] * RPM)
    _, error = numbers(recording, "/axis1/error/error")
    np.testing.assert_allclose(error, (read["reference_rad_s"] - read["velocity_rad_s"]) * RPM)


@pytest.mark.parametrize("name", ["limits", "limits_2", "overview", "overview2"])
def test_an_axis_may_be_called_like_a_branch_of_the_recording(tmp_path: Path, rows: Rows, name: str) -> None:
    plan = plan_for(tmp_path)
    path = write_run(replace(plan, review=ReviewPlan((AxisPlan(name, 6_250.0),))), rows)
    assert numbers(path, f"/{name}/speed/measured")[0].size
    assert numbers(path, f"/limits/{name}/delay/deadline")[0].size


def test_every_dropout_is_marked_in_both_plots(recording: Path, rows: Rows) -> None:
    due_at = rows["due_at"][rows["fate"] != FATE_SAMPLE] - ORIGIN
    assert due_at.size > 20
    for entity in ("/axis1/speed/dropped", "/axis1/delay/dropped"):
        np.testing.assert_array_equal(numbers(recording, entity)[0], due_at)


def test_torque_and_delay(recording: Path, rows: Rows) -> None:
    _, torque_mnm = numbers(recording, "/axis1/torque/command")
    np.testing.assert_allclose(torque_mnm, 1e3 * rows["command_torque_nm"])
    np.testing.assert_allclose(numbers(recording, "/axis1/torque/load")[1], 1e3 * rows["load_torque_nm"])
    _, delay = numbers(recording, "/axis1/delay/delay")
    np.testing.assert_allclose(delay, rows["delay_ns"][rows["delay_ns"] >= 0] / NS_PER_US)
    times, deadline = numbers(recording, "/limits/axis1/delay/deadline")
    assert set(deadline.tolist()) == {2_000.0}
    assert (times[0], times[-1]) == (0, (CYCLES - 1) * NS_PER_MS)


def test_uncertain_readings_are_marked_at_their_delay(tmp_path: Path, rows: Rows) -> None:
    doubtful = rows[:40].copy()
    doubtful["certain"][5:9] = 0
    path = write_run(plan_for(tmp_path), doubtful)
    times, at_us = numbers(path, "/axis1/delay/uncertain")
    np.testing.assert_array_equal(times, doubtful["due_at"][5:9] - ORIGIN)
    expected = np.where(doubtful["delay_ns"] == NOTHING, 0, doubtful["delay_ns"])[5:9] / NS_PER_US
    np.testing.assert_allclose(at_us, expected)


def test_the_way_of_the_commands(tmp_path: Path, rows: Rows) -> None:
    sent = rows[:40].copy()
    sent["command_on_bus_at"] = sent["command_handed_at"] + 90 * NS_PER_US
    sent["command_acts_by"][7] = NOTHING
    sent["command_fate"][7] = COMMAND_FATES.index(CommandFate.LOST)
    path = write_run(plan_for(tmp_path), sent)
    assert set(numbers(path, "/axis1/commands/on_bus")[1].tolist()) == {90.0}
    times, acting = numbers(path, "/axis1/commands/acting")
    assert set(acting.tolist()) == {300.0}
    assert times.size == 39
    assert numbers(path, "/axis1/commands/lost")[0].tolist() == [7 * NS_PER_MS]


def test_the_clock_is_shown_from_where_it_began_with_its_bounds(tmp_path: Path, rows: Rows) -> None:
    told = rows[:40].copy()
    told["clock_offset_ns"] = 123_456 + 500 * np.arange(40)
    told["clock_offset_ns"][0] = NOTHING
    path = write_run(plan_for(tmp_path), told)
    times, offset = numbers(path, "/axis1/clock/offset")
    np.testing.assert_array_equal(times, told["due_at"][1:] - ORIGIN)
    np.testing.assert_allclose(offset, 0.5 * np.arange(39))
    np.testing.assert_allclose(numbers(path, "/axis1/clock/lower")[1], offset - 1.2)
    np.testing.assert_allclose(numbers(path, "/axis1/clock/upper")[1], offset + 1.2)


def test_cycles_without_sync_have_a_lane_of_their_own(tmp_path: Path) -> None:
    rows = plain_rows(6, fate=[0, 0, FATE_MISSED, FATE_MISSED, 0, 0])
    path = write_run(plan_for(tmp_path), rows, events=())
    times, states = lane(path, "host")
    assert states == [["In time"], ["MISSED"], ["In time"]]
    assert times.tolist() == [0, 2 * NS_PER_MS, 4 * NS_PER_MS]


def test_states_of_loop_and_records_share_a_track(recording: Path) -> None:
    times, states = lane(recording, "axis1 drive")
    assert states == [["Switched on"], ["Operation enabled"]]
    assert times[0] == -5 * NS_PER_MS
    assert 0 < times[1] < NS_PER_MS, "when the statusword came, not when the cycle was due"
    assert lane(recording, "phase")[1] == [["Load step"]]
    link = [state for (state,) in lane(recording, "axis1 link")[1]]
    assert link[0] == "OK"
    assert "DOWN" in link


@pytest.mark.parametrize("events_first", [True, False])
def test_a_state_told_twice_is_shown_once_whichever_came_first(
    tmp_path: Path, rows: Rows, events_first: bool
) -> None:
    enabled_at = Instant(int(rows["status_told_at"][rows["fate"] == FATE_SAMPLE][0]))
    told: tuple[RunEvent, ...] = (
        BeginEvent(Instant(ORIGIN)),
        StateEvent(enabled_at, "axis1 drive", "operation enabled"),
        StateEvent(Instant(ORIGIN + CYCLES * NS_PER_MS), "axis1 drive", "switch on disabled"),
    )
    plan = plan_for(tmp_path)
    review = Review(plan.review)
    review.add(rows)
    path = tmp_path / "run.rrd"
    telemetry = Telemetry(plan, "a-recording", rr.FileSink(path))
    telemetry.take_events(told if events_first else told[:2])
    telemetry.take_rows(rows)
    telemetry.take_events(() if events_first else told[2:])
    outcome = whole_outcome(review.figures().cycles)
    telemetry.finish(summarise(review.figures(), outcome, plan.review.limits, "", 1), review)
    _, states = lane(path, "axis1 drive")
    assert states == [["Operation enabled"], ["Switch on disabled"]]


def test_events_before_time_zero_have_negative_times(recording: Path) -> None:
    times, texts = columns(recording, "/events", "TextLog:text")
    assert times.tolist() == [-7 * NS_PER_MS, NS_PER_MS, (CYCLES - 1) * NS_PER_MS]
    ended = "1.499 s  run ended: passed, 1 of 1 limits kept"
    assert texts == [["-0.007 s  set up"], ["0.001 s  load"], [ended]]


def test_the_page_tells_the_verdict(recording: Path) -> None:
    _, texts = columns(recording, "/verdict", "TextDocument:text")
    assert [str(text[0]).splitlines()[0] for text in texts] == [
        "# synthetic · running",
        "# synthetic · PASSED",
    ]


def test_the_whole_summary_is_in_the_recording(recording: Path, rows: Rows) -> None:
    _, ((text,),) = columns(recording, "/summary", "TextDocument:text")
    told = from_plain(Summary, json.loads(str(text)))
    assert told.cycles == rows.size
    assert told.verdict.passed


def test_the_histogram_holds_every_reading_that_came(recording: Path, rows: Rows) -> None:
    _, ((values,),) = columns(recording, "/delay_histogram/axis1/delay", "BarChart:values")
    assert isinstance(values, dict)
    assert sum(values["buffer"]) == (rows["delay_ns"] >= 0).sum()


def test_the_recording_carries_its_layout(recording: Path) -> None:
    reader = RrdReader(recording)
    assert len(reader.recordings()) == 1
    names = {
        name
        for store in reader.blueprints()
        for chunk in reader.stream(store=store)
        for name in _view_names(chunk.to_record_batch())
    }
    assert {"States", "Speed [r/min]", "Speed error [r/min]", "Torque [mN m]", "Verdict", "Events"} <= names
    assert {
        "Commands, from hand-over [us]",
        "Clock offset since the start, with its bounds [us]",
    } <= names
    delays = {"Delay of the readings [us] · deadline 2000", "axis1: readings over delay [us], deadline 2000"}
    assert delays <= names


def _view_names(batch: object) -> list[str]:
    column = "ViewBlueprint:display_name"
    if column not in batch.schema.names:  # type: ignore[attr-defined]
        return []
    return [name for names in batch.column(column).to_pylist() for name in names or []]  # type: ignore[attr-defined]


def test_the_overview_opens_on_the_whole_run(recording: Path) -> None:
    """Not on the viewer's own window of a minute: each of its views has the range of the run."""
    found = [
        (low, high) for low, high in view_ranges(recording) if low <= 0 and high >= (CYCLES - 1) * NS_PER_MS
    ]
    assert len(found) >= 5
    assert all(high - low < 1.2 * CYCLES * NS_PER_MS for low, high in found)


def test_a_long_run_has_an_envelope_beside_its_rows(tmp_path: Path) -> None:
    reference = np.zeros(20_000)
    reference[11_111] = 7.0
    path = write_run(plan_for(tmp_path), plain_rows(20_000, reference=reference), events=())
    times, shown = numbers(path, "/overview/axis1/speed/reference")
    assert times.size <= 2 * (BUCKETS + 1)
    assert times[shown != 0.0].tolist() == [11_111 * NS_PER_MS]
    assert numbers(path, "/axis1/speed/reference")[0].size == 20_000


def test_dropouts_have_a_lane_by_cause(tmp_path: Path) -> None:
    rows = plain_rows(8, fate=[0, 1, 1, 0, 2, 3, 0, FATE_MISSED])
    path = write_run(plan_for(tmp_path), rows, events=())
    _, states = lane(path, "axis1 dropouts")
    assert [state for (state,) in states] == ["-", "Lost", "-", "Late", "Stale", "-", "Missed", "-"]


def test_a_stretch_with_few_dropouts_is_told_from_one_without_readings(tmp_path: Path) -> None:
    rows = plain_rows(60_000, fate=np.where(np.arange(60_000) % 50 == 7, 1, 0))
    rows["fate"][30_000:31_000] = 1
    path = write_run(plan_for(tmp_path), rows, events=())
    times, states = lane(path, "axis1 dropouts")
    lost = [at / 1e9 for at, (state,) in zip(times, states, strict=True) if state == "Lost"]
    assert len(lost) == 1
    assert lost[0] == pytest.approx(30.0, abs=0.2)
    assert {state for (state,) in states} == {"Lost, few", "Lost", "-"}


def test_the_lane_of_the_error_is_red_where_its_limit_is_broken(tmp_path: Path) -> None:
    plan = plan_for(tmp_path)
    limits = VerdictLimits(speed_error_peak_percent_max=5.0)
    plan = replace(plan, review=replace(plan.review, limits=limits))
    reference, velocity = np.full(1_000, 100.0), np.full(1_000, 100.0)
    reference[:100] = velocity[:100] = 0.0
    velocity[600:650] = 94.0
    rows = plain_rows(1_000, reference=reference, velocity=velocity)
    path = write_run(plan, rows, events=())
    times, states = lane(path, "axis1 error")
    assert [state for (state,) in states] == ["Kept", "Settling", "Kept", "BEYOND", "Kept", "-"]
    np.testing.assert_allclose(times / NS_PER_MS, [0, 100, 350, 600, 650, 999], atol=2)
    _, outcome = lane(path, "verdict")
    assert [state for (state,) in outcome] == ["Not passed", "-"]
    # the limit is drawn where it holds: not while the speed settles
    times, most = numbers(path, "/limits/axis1/error/most")
    assert set(np.round(most, 6)) == {round(5.0 * RPM, 6)}
    assert (times / NS_PER_MS).tolist() == [0, 100, 350, 999]


def test_an_injected_fault_has_a_lane(tmp_path: Path) -> None:
    track = "injected loss: drive to host"
    events = (
        StateEvent(Instant(2 * NS_PER_MS), track, "active"),
        StateEvent(Instant(5 * NS_PER_MS), track, "-"),
    )
    path = write_run(plan_for(tmp_path), plain_rows(9), events=events)
    times, states = lane(path, "injected loss")
    assert [state for (state,) in states] == ["-", "Injected", "-"]
    assert (times / NS_PER_MS).tolist() == [0, 2, 5]


def test_a_long_event_goes_on_in_the_next_line(tmp_path: Path) -> None:
    text = (
        "axis1: the drive has stopped by itself: EMCY 8612h, position limit, with everything it said before"
    )
    path = write_run(plan_for(tmp_path), plain_rows(3), (TextEvent(Instant(0), "CRITICAL", text),))
    lines = [str(line) for (line,) in columns(path, "/events", "TextLog:text")[1]]
    assert max(map(len, lines)) <= 64
    assert text in " ".join(line.strip() for line in lines)


def test_two_axes_have_plots_of_their_own(tmp_path: Path) -> None:
    review = ReviewPlan((AxisPlan("left", 6_250.0), AxisPlan("right", 6_250.0)))
    plan = replace(plan_for(tmp_path), review=review)
    left, right = synthetic_records(40), synthetic_records(40, seed=2, axis=1)
    rows = rows_of([record for pair in zip(left, right, strict=True) for record in pair])
    path = write_run(plan, rows, events=())
    for number, name in enumerate(("left", "right")):
        mine = rows[rows["axis"] == number]
        np.testing.assert_array_equal(
            numbers(path, f"/{name}/torque/command")[1], 1e3 * mine["command_torque_nm"]
        )


def test_a_run_without_a_cycle_still_shows_its_events(tmp_path: Path) -> None:
    path = write_run(plan_for(tmp_path), rows_of([]), events=EVENTS[:2])
    texts = columns(path, "/events", "TextLog:text")[1]
    why = "dropouts_percent_max = 10, and nothing was measured"
    assert [text[0] for text in texts[:1]] == ["0.000 s  set up"]
    told = " ".join(str(text[0]).strip() for text in texts[1:])
    assert told == f"0.002 s  run ended: not measured, 0 of 1 limits kept; {why}"


@pytest.mark.parametrize(
    ("width", "expected"), [(1, 1), (900, 1), (1_001, 2), (2_000, 2), (6_000, 10), (21_000, 50)]
)
def test_bars_have_round_widths(width: int, expected: int) -> None:
    assert round_width(width) == expected * NS_PER_US


def test_a_histogram_of_nothing_is_not_shown(tmp_path: Path) -> None:
    path = write_run(plan_for(tmp_path), rows_of([]))
    assert columns(path, "/delay_histogram/axis1/delay", "BarChart:values")[1] == []


def test_a_sink_that_cannot_be_opened_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"run\.rrd"):
        Telemetry(plan_for(tmp_path), "a-recording", rr.FileSink(tmp_path / "none" / "run.rrd"))


def test_a_negative_delay_is_drawn_and_lies_within_the_plot(tmp_path: Path) -> None:
    rows = plain_rows(4)
    rows["delay_ns"] = 300_000, -1, -250_000, NOTHING
    path = write_run(plan_for(tmp_path), rows, events=())
    _, delays_us = numbers(path, "/axis1/delay/delay")
    assert delays_us.tolist() == pytest.approx([300.0, -0.001, -250.0])
    bottoms = [low for low, _ in _axis_ranges(path)]
    assert min(bottoms) <= -250.0


def _axis_ranges(path: Path) -> list[tuple[float, float]]:
    """Of all plots of the last layout."""
    reader = RrdReader(path)
    found = []
    for store in reader.blueprints():
        for chunk in reader.stream(store=store):
            batch = chunk.to_record_batch()
            if "ScalarAxis:range" in batch.schema.names:
                found += [tuple(low_high) for (low_high,) in batch.column("ScalarAxis:range").to_pylist()]
    return found


def test_what_the_run_was_is_a_property_of_the_recording(tmp_path: Path) -> None:
    events = (IdentityEvent(Instant(ORIGIN - 9), "axis1", "a drive of the lab"), *EVENTS)
    path = write_run(plan_for(tmp_path), plain_rows(4), events)
    found = {
        name: batch.column(name).to_pylist()[0][0]
        for chunk in RrdReader(path).stream()
        for batch in [chunk.to_record_batch()]
        for name in batch.schema.names
        if "properties" in chunk.entity_path and "run" in chunk.entity_path and not name.startswith("rerun.")
    }
    assert found["drives"] == '{"axis1": "a drive of the lab"}'
    assert found["seed"] == "2012"
    assert found["format"] == FORMAT
