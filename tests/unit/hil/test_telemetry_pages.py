"""run.rrd of runs with something of everything: each series at its place, and what the pages open on."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Instant
from servobench.hil.loop.cycle_record import FATE_MISSED, NOTHING
from servobench.hil.recording.telemetry import Telemetry, _end_event
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import AxisPlan, ObservedDrive, RecordingPlan, ReviewPlan
from servobench.hil.rows.records import Rows
from servobench.hil.rows.side_rows import BeginEvent, LoadEvent, RunEvent, StateEvent, TextEvent
from servobench.hil.verdict.summary import summarise
from servobench.hil.verdict.verdict import Check, LimitResult
from tests.rrd_columns import columns, lane, line, numbers, view_ranges
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.row_tools import plain_rows
from tests.unit.hil.test_drawn_rows import MAPPING, TEMPERATURE, VOLTAGE, frames, pdo
from tests.unit.hil.test_summary import summary_with

RPM: Final = 30.0 / np.pi
MS: Final = NS_PER_MS


def write(
    plan: RecordingPlan, blocks: Sequence[Rows], events: Sequence[RunEvent] = (), live: bool = False
) -> Path:
    assert plan.folder is not None
    path = plan.folder / "run.rrd"
    review = Review(plan.review)
    telemetry = Telemetry(plan, "a-recording", rr.FileSink(path), live=live)
    telemetry.take_events(events)
    for block in blocks:
        review.add(block)
        telemetry.take_rows(block)
        if live:
            telemetry.show_running(review)
    outcome = whole_outcome(review.figures().cycles)
    telemetry.finish(summarise(review.figures(), outcome, plan.review.limits, "", 1), review)
    return path


def names(path: Path) -> set[str]:
    """Of all entities."""
    return {str(chunk.entity_path) for chunk in RrdReader(path).stream()}


def shown(path: Path, track: str) -> list[tuple[float, str]]:
    """The states of a lane, in ms."""
    times, states = lane(path, track)
    return [(at / MS, str(state)) for at, (state,) in zip(times, states, strict=True)]


@pytest.fixture
def plan(tmp_path: Path) -> RecordingPlan:
    return plan_for(tmp_path)


def test_loads_are_drawn_in_the_unit_of_their_axis(plan: RecordingPlan) -> None:
    strong = AxisPlan("strong", 1.0, rated_torque_nm=30.0)
    weak = AxisPlan("weak", 1.0, rated_torque_nm=20.0)
    both = replace(plan, review=ReviewPlan((strong, weak)))
    events: list[RunEvent] = [
        BeginEvent(Instant(0)),
        LoadEvent(Instant(2 * MS), "strong", 0.5, 1.0),
        LoadEvent(Instant(3 * MS), "weak", 0.5, 1.0),
        LoadEvent(Instant(4 * MS), "nobody", 0.5, 1.0),
    ]
    rows = np.repeat(plain_rows(5), 2)
    rows["axis"][1::2] = 1
    path = write(both, [rows], events)
    for name, at_ms, value in (("strong", 2, 0.5), ("weak", 3, 500.0), ("nobody", 4, 0.5)):
        times, values = numbers(path, f"/{name}/torque/brake")
        assert (times.tolist(), values.tolist()) == ([at_ms * MS], [value])


def test_what_controllers_tell_has_a_series_for_each_name(plan: RecordingPlan) -> None:
    rows = plain_rows(4)
    rows["channel_0"], rows["channel_1"] = np.arange(4), -np.arange(4)
    path = write(replace(plan, channels={"axis1": ("gap", "force")}), [rows])
    assert numbers(path, "/axis1/controller/gap")[1].tolist() == [0, 1, 2, 3]
    assert numbers(path, "/axis1/controller/force")[1].tolist() == [0, -1, -2, -3]


@pytest.mark.parametrize(
    ("missed", "host"), [(False, False), (True, True)], ids=["in time", "a cycle without SYNC"]
)
def test_the_host_has_a_lane_where_it_was_late(plan: RecordingPlan, missed: bool, host: bool) -> None:
    rows = plain_rows(4, fate=[0, FATE_MISSED if missed else 0, 0, 0])
    path = write(plan, [rows])
    lanes = [
        mapping["source_component"]
        for store in RrdReader(path).blueprints()
        for chunk in RrdReader(path).stream(store=store)
        for batch in [chunk.to_record_batch()]
        if "VisualizerInstruction:component_map" in batch.schema.names
        for mappings in batch.column("VisualizerInstruction:component_map").to_pylist()
        for mapping in mappings
    ]
    live = 1
    assert (lanes.count("host") > live) is host


@pytest.mark.parametrize(
    ("early_ms", "late_ms", "begin_ms", "end_ms"),
    [
        (0, 0, 0, 100),
        (5, 10, -5, 110),
        # of what was before the first cycle a tenth of the cycles is shown, of what came after them a half
        (30, 90, -10, 150),
        (10, 50, -10, 150),
    ],
)
def test_pages_open_on_the_cycles_and_some_of_what_was_around_them(
    plan: RecordingPlan, early_ms: int, late_ms: int, begin_ms: int, end_ms: int
) -> None:
    origin = 200 * MS
    rows = plain_rows(101)
    for column in ("due_at", "woke_at"):
        rows[column] += origin
    events: list[RunEvent] = [
        TextEvent(Instant(origin - early_ms * MS), "INFO", "x"),
        BeginEvent(Instant(origin)),
        TextEvent(Instant(origin + (100 + late_ms) * MS), "INFO", "y"),
    ]
    path = write(plan, [rows[:50], rows[50:]], events)
    margin = (end_ms - begin_ms) * MS // 50
    expected = (begin_ms * MS - margin, end_ms * MS + margin)
    assert any(window == pytest.approx(expected, abs=2_000) for window in view_ranges(path)), view_ranges(
        path
    )


def test_an_event_of_an_injected_fault_is_a_window_to_the_end(plan: RecordingPlan) -> None:
    events: list[RunEvent] = [StateEvent(Instant(2 * MS), "injected loss: x", "active")]
    assert shown(write(plan, [plain_rows(9)], events), "injected loss") == [
        (0.0, "-"),
        (2.0, "Injected"),
        (8.0, "-"),
    ]


def test_a_run_seen_live_has_its_deadline_with_each_block_and_no_envelope(plan: RecordingPlan) -> None:
    blocks = np.array_split(plain_rows(9_000), 2)
    path = write(plan, blocks, live=True)
    times, deadline = numbers(path, "/limits/axis1/delay/deadline")
    assert set(deadline.tolist()) == {2000.0}
    assert times[:4].tolist() == [0, 4_499 * MS, 4_500 * MS, 8_999 * MS]
    assert not any(name.startswith("/overview") for name in names(path))
    pages = [str(text).splitlines()[0] for (text,) in columns(path, "/verdict", "TextDocument:text")[1]]
    assert pages[:3] == ["# synthetic · running"] * 3
    assert len(pages) == 4


def test_a_drive_s_state_told_before_the_first_cycle_stays_in_its_lane(plan: RecordingPlan) -> None:
    """Every lane begins without a label, as a view complains of one that is not there: before all states."""
    rows = plain_rows(9)
    rows["statusword"], rows["status_told_at"] = 0x0637, -2 * MS
    _, labels = columns(write(plan, [rows], live=True), "/state", "axis1 drive")
    assert labels == [[None], ["Operation enabled"]]


@pytest.mark.parametrize(("rows", "enveloped"), [(8_000, False), (8_001, True)])
def test_an_envelope_is_made_of_more_rows_than_it_has_itself(
    plan: RecordingPlan, rows: int, enveloped: bool
) -> None:
    path = write(plan, [plain_rows(rows, reference=1.0)])
    assert ("/overview/axis1/speed/reference" in names(path)) is enveloped


@pytest.fixture
def delayed() -> Rows:
    """100 readings: 98 after 660 us, the others after 5050 us."""
    rows = plain_rows(100)
    rows["delay_ns"] = 660 * NS_PER_US
    rows["delay_ns"][[7, 8]] = 5_050 * NS_PER_US
    return rows


def bars(path: Path, name: str) -> tuple[list[int], list[float], list[float]]:
    """Counts, middles and widths, us."""
    entity = f"/delay_histogram/axis1/{name}"
    counts: Any = columns(path, entity, "BarChart:values")[1]
    middles: Any = columns(path, entity, "BarChart:abscissa")[1]
    widths: Any = columns(path, entity, "BarChart:widths")[1]
    return list(counts[-1][0]["buffer"]), list(middles[-1][0]["buffer"]), list(widths[-1])


def test_the_histogram_s_last_bar_holds_what_lies_beyond_twice_the_99th_percentile(
    plan: RecordingPlan, delayed: Rows
) -> None:
    """44 bars at most, of a round width: up to 5050 us they are 200 us wide, and the deadline is in view."""
    counts, middles, widths = bars(write(plan, [delayed]), "delay")
    assert set(widths) == {200.0}
    assert middles == [100.0 + 200.0 * place for place in range(len(counts))]
    assert len(counts) == 26
    assert {place: count for place, count in enumerate(counts) if count} == {3: 98, 25: 2}
    deadline = bars(write(plan, [delayed]), "deadline")
    assert (deadline[0], deadline[1]) == ([98], [2000.0])
    assert deadline[2] == pytest.approx([60.0])


def test_what_lies_beyond_the_bars_is_in_the_last(plan: RecordingPlan, delayed: Rows) -> None:
    delayed["delay_ns"][8] = 660 * NS_PER_US
    counts, middles, widths = bars(write(plan, [delayed]), "delay")
    assert set(widths) == {50.0}, "of 2 times 660 us by 44 the next round width"
    assert (len(counts), middles[0]) == (44, 25.0)
    assert {place: count for place, count in enumerate(counts) if count} == {13: 99, 43: 1}


def test_a_deadline_out_of_view_is_no_bar(plan: RecordingPlan) -> None:
    rows = plain_rows(100)
    rows["delay_ns"] = 499 * NS_PER_US
    path = write(plan, [rows])
    assert "/delay_histogram/axis1/deadline" not in names(path)
    rows["delay_ns"] = NOTHING
    assert "/delay_histogram/axis1/delay" not in names(write(plan, [rows]))


@pytest.mark.parametrize("taken", ["with the rows", "after them"])
def test_what_a_drive_tells_beside_is_drawn_with_the_next_rows_or_at_the_end(
    plan: RecordingPlan, tmp_path: Path, taken: str
) -> None:
    observing = replace(plan, observed={"axis1": ObservedDrive(3, 0, (TEMPERATURE, VOLTAGE))})
    review = Review(plan.review)
    path = tmp_path / "run.rrd"
    telemetry = Telemetry(observing, "a-recording", rr.FileSink(path))
    if taken == "after them":
        telemetry.take_rows(plain_rows(4))
    telemetry.observed.take(frames(*MAPPING, pdo(-250, 48_000, 5), pdo(251, 50_000, 2 * MS)))
    if taken == "with the rows":
        telemetry.take_rows(plain_rows(4))
    telemetry.finish(summary_with(), review)
    times, celsius = numbers(path, "/axis1/observed/2030h_1")
    assert (times.tolist(), celsius.tolist()) == ([5, 2 * MS], pytest.approx([-25.0, 25.1]))
    assert numbers(path, "/axis1/observed/6079h_0")[1].tolist() == pytest.approx([48.0, 50.0])
    assert columns(path, "/axis1/observed/6079h_0", "SeriesLines:names")[1] == [["DC link"]]


@pytest.mark.parametrize(("dropped", "marked"), [(30, True), (31, False)])
def test_thirty_dropouts_are_marked_on_the_line(plan: RecordingPlan, dropped: int, marked: bool) -> None:
    """On the page that opens first; from near all of them are."""
    path = write(plan, [plain_rows(100, fate=[1] * dropped + [0] * (100 - dropped))])
    shown_marks = [
        text
        for store in RrdReader(path).blueprints()
        for chunk in RrdReader(path).stream(store=store)
        for batch in [chunk.to_record_batch()]
        if "ViewContents:query" in batch.schema.names
        for texts in batch.column("ViewContents:query").to_pylist()
        for text in texts
        if text == "+ /axis1/speed/dropped"
    ]
    live, zoomed = 1, 1
    assert len(shown_marks) == live + zoomed + marked


def test_a_file_that_cannot_be_written_is_an_os_error(plan: RecordingPlan, tmp_path: Path) -> None:
    telemetry = Telemetry(plan, "a-recording", rr.FileSink(tmp_path / "run.rrd"))
    asked: list[float] = []

    def fail(*, timeout_sec: float) -> None:
        asked.append(timeout_sec)
        raise RuntimeError("no room")

    whole = telemetry._stream
    telemetry._stream = SimpleNamespace(flush=fail)  # type: ignore[assignment]
    with pytest.raises(OSError, match=r"^the telemetry cannot be written: no room$"):
        telemetry.flush()
    assert asked == [10.0]
    whole.disconnect()


def test_rows_of_no_cycle_change_nothing(plan: RecordingPlan) -> None:
    path = write(plan, [plain_rows(0), plain_rows(3), plain_rows(0)])
    assert numbers(path, "/axis1/speed/reference")[0].tolist() == [0, MS, 2 * MS]


def test_a_state_between_two_that_are_shown_is_put_in_its_place(plan: RecordingPlan) -> None:
    events: list[RunEvent] = [
        BeginEvent(Instant(0)),
        StateEvent(Instant(10 * MS), "phase", "running"),
        StateEvent(Instant(30 * MS), "phase", "stopped"),
        StateEvent(Instant(20 * MS), "phase", "stopping"),
        StateEvent(Instant(15 * MS), "phase", "running"),
        StateEvent(Instant(40 * MS), "phase", "stopped"),
    ]
    assert shown(write(plan, [plain_rows(3)], events), "phase") == [
        (10.0, "Running"),
        (20.0, "Stopping"),
        (30.0, "Stopped"),
    ]


@pytest.mark.parametrize(
    ("results", "level", "text"),
    [
        ("", "ERROR", "run ended: not passed, 0 of 0 limits kept; why"),
        ("kb", "ERROR", "run ended: not passed, 1 of 2 limits kept; why"),
    ],
)
def test_the_end_is_an_event_with_how_many_limits_were_kept(results: str, level: str, text: str) -> None:
    kinds = {"k": LimitResult.KEPT, "b": LimitResult.BROKEN}
    checks = tuple(Check("delay_p99_us_max", 1.0, 2.0, kinds[letter]) for letter in results)
    summary = summary_with()
    verdict = replace(summary.verdict, limits=checks)
    expected = text.replace("why", verdict.reason).rstrip("; ")
    assert _end_event(Instant(7), replace(summary, verdict=verdict)) == TextEvent(Instant(7), level, expected)


@pytest.mark.long
def test_no_line_crosses_a_gap_neither_of_the_rows_nor_of_the_envelope(tmp_path: Path) -> None:
    """20 s, half a second of them without a reading; single ones are gaps of the rows alone."""
    rows = plain_rows(20_000, fate=np.where(np.arange(20_000) % 100 == 7, 1, 0))
    rows["fate"][5_000:5_500] = 1
    path = write(plan_for(tmp_path), np.array_split(rows, 2))
    for drawn in ("speed/measured", "error/error", "torque/measured"):
        missing = np.flatnonzero(rows["fate"] != 0).tolist()
        assert gaps_in(path, f"/axis1/{drawn}") == missing, "a cycle without a reading is a gap"
        assert gaps_in(path, f"/overview/axis1/{drawn}") == [5_000.0]
    for drawn in ("speed/reference", "torque/command"):
        assert gaps_in(path, f"/overview/axis1/{drawn}") == []


def gaps_in(path: Path, entity: str) -> Any:
    """Instants without a number, ms."""
    times, values = line(path, entity)
    return (times[np.isnan(values)] / NS_PER_MS).tolist()
