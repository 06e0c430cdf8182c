"""Claims about runs at their very limits, and what a run tells of itself; rows and recordings are made up."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.recording.run_metadata import write_summary
from servobench.hil.recording.sealer import Sealer
from servobench.hil.rows.records import Rows
from servobench.hil.rows.records_file import RecordsWriter
from servobench.hil.testing.history import AxisHistory, Stretch
from servobench.hil.testing.run import Run
from servobench.hil.testing.wire import SeenFrame, Wire
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.verdict import Finding, VerdictKind
from tests.unit.hil.made_runs import BENCH
from tests.unit.hil.row_tools import plain_rows
from tests.unit.hil.test_report import summary

ENABLED, DISABLED, FAULT = 0x0237, 0x0240, 0x0218
CYCLES, STEP, LOAD = 500, 100, 300


def rows(settled_after: int = 20, band: float = 1.0) -> Rows:
    """A step to 100 rad/s in cycle 100, a load in cycle 300; an error of 5 for so many cycles after each."""
    number = np.arange(CYCLES)
    made = plain_rows(CYCLES, statusword=ENABLED)
    made["reference_rad_s"] = np.where(number >= STEP, 100.0, 0.0)
    made["load_torque_nm"] = np.where(number >= LOAD, 0.5, 0.0)
    since = np.where(number >= LOAD, number - LOAD, number - STEP)
    error = np.where((since >= 0) & (since <= settled_after), 5.0, band)
    made["velocity_rad_s"] = made["reference_rad_s"] - np.where(number >= STEP, error, 0.0)
    return made


def run_of(its: Rows, folder: Path = Path("nowhere"), **more: Any) -> Run:
    run = Run(BENCH, folder)
    found = summary(**more)
    vars(run).update(rows=its, summary=found, events=[], wire=Wire(recording=folder))
    return run


def told(claim: Callable[[], object]) -> str:
    with pytest.raises(AssertionError) as caught:
        claim()
    return str(caught.value)


PLACE = "\nrecording: nowhere"


@pytest.mark.parametrize(
    ("within_s", "holds"), [(0.021, True), (0.0205, True), (0.0195, False), (0.01, False)]
)
def test_a_speed_has_settled_before_the_time_is_up(within_s: float, holds: bool) -> None:
    """Last outside of the band 20 ms after the change."""
    run = run_of(rows())
    if holds:
        assert run.assert_settles(within_s=within_s) == pytest.approx([0.02, 0.02])
        return
    assert told(lambda: run.assert_settles(within_s=within_s)) == (
        f"axis1: {within_s:g} s after the reference of 100 rad/s (954.9 r/min) at 0.100 s the speed is still "
        f"up to 5 % (5 rad/s) off, the band is 2 %; last outside of it after 0.020 s{PLACE}"
    )


@pytest.mark.parametrize(("band_percent", "settled_s"), [(1.0, 0.02), (5.0, 0.0), (4.999, 0.02)])
def test_a_band_holds_its_edge(band_percent: float, settled_s: float) -> None:
    found = run_of(rows()).assert_settles(within_s=0.1, band_percent=band_percent)
    assert found == pytest.approx([settled_s] * 2)


def test_a_stretch_is_judged_if_it_is_as_long_as_the_time_to_settle() -> None:
    """The stretches reach to 199 ms after their changes."""
    run = run_of(rows())
    assert len(run.assert_settles(within_s=0.1985)) == 2
    assert told(lambda: run.assert_settles(within_s=0.1995)) == (
        f"axis1: no stretch of 0.1995 s after a change to settle in{PLACE}"
    )


def test_a_stretch_of_just_the_time_to_settle_is_judged() -> None:
    """Of 1/512 s each, whose times are whole in binary; the stretches reach to 199 of them."""
    its = rows()
    its["due_at"] = np.arange(CYCLES) * (10**9 // 512)
    assert run_of(its).assert_settles(within_s=199 / 512) == [20 / 512] * 2
    told(lambda: run_of(its).assert_settles(within_s=np.nextafter(199 / 512, 1.0)))


@pytest.mark.parametrize(("after_s", "found"), [(0.1, 1), (0.1015, 1), (0.0985, 1), (0.3, 1)])
def test_a_change_is_found_within_one_and_a_half_cycles(after_s: float, found: int) -> None:
    assert len(run_of(rows()).assert_settles(within_s=0.1, after_s=after_s)) == found


def test_a_change_that_is_not_there_is_a_mistake_of_the_test() -> None:
    with pytest.raises(
        ValueError, match=r"^axis1: nothing changes at 0.102 s; changes end at 0.100 s, 0.300 s$"
    ):
        run_of(rows()).assert_settles(within_s=0.1, after_s=0.102)
    calm = rows()
    calm["reference_rad_s"], calm["load_torque_nm"] = 0.0, 0.0
    with pytest.raises(
        ValueError, match=r"^axis1 has no reference to take percent of; give the error in rad/s$"
    ):
        run_of(calm).assert_settles(within_s=0.1, after_s=0.1)


def test_readings_after_the_time_are_needed() -> None:
    lost = rows()
    lost["fate"][LOAD + 30 :] = 1
    run = run_of(lost)
    assert run.assert_settles(within_s=0.029) == pytest.approx([0.02, 0.02])
    assert told(lambda: run.assert_settles(within_s=0.03)) == (
        f"axis1: 0.03 s after the load of 0.5 N m at 0.300 s there is no reading any more{PLACE}"
    )


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"percent": 5.0}, ""),
        ({"percent": 4.99}, "speed error 5 % (5 rad/s at 0.100 s), at most 4.99 % asked for"),
        ({"rad_s": 5.0}, ""),
        ({"rad_s": 4.99}, "speed error 5 rad/s at 0.100 s, at most 4.99 rad/s asked for"),
        ({"rad_s": 1.0, "from_s": 0.121, "until_s": 0.3}, ""),
        (
            {"rad_s": 1.0, "from_s": 0.121, "until_s": 0.301},
            "speed error 5 rad/s at 0.300 s, at most 1 rad/s asked for",
        ),
        (
            {"rms_rad_s": 3.0, "from_s": 0.1, "until_s": 0.122},
            "speed error 4.89 rad/s rms (peak 5 rad/s at 0.100 s), at most 3 rad/s rms asked for",
        ),
        ({"rms_rad_s": 5.0, "from_s": 0.1, "until_s": 0.121}, ""),
        ({"percent": 1.0, "from_s": 0.5}, "no reading between 0.5 s and inf s"),
    ],
)
def test_an_error_may_be_as_large_as_its_limit(asked: dict[str, float], words: str) -> None:
    run = run_of(rows())
    if not words:
        run.assert_error_below(**asked)  # type: ignore[arg-type]
        return
    assert told(lambda: run.assert_error_below(**asked)) == f"axis1: {words}{PLACE}"  # type: ignore[arg-type]


def test_a_run_that_was_cut_short_keeps_no_claim() -> None:
    run = run_of(rows(), completed=False)
    cut = f"the run was cut short: lost the bus{PLACE}"
    assert told(lambda: run.assert_settles(within_s=0.1)) == cut
    assert told(lambda: run.assert_error_below(percent=99.0)) == cut
    assert told(run.assert_dropouts_handled) == cut
    run.assert_stayed(State.OPERATION_ENABLED)


def test_a_run_of_which_nothing_was_asked_has_not_passed() -> None:
    run = run_of(rows(), limits=VerdictLimits())
    assert told(run.assert_passed) == f"{BENCH.source} has no limit in [verdict] to keep{PLACE}"
    found = summary(passed=False).also(Finding(VerdictKind.NOT_TRUSTWORTHY, "came too early"))
    vars(run)["summary"] = found
    assert told(run.assert_passed) == (
        f"not trustworthy: came too early\nnot passed: delay_p99_us_max = 2000, found 2345{PLACE}"
    )
    assert (run.verdict, run.digest) == (found.verdict, found.digest)


def dropping(places: list[int]) -> Run:
    its = rows()
    its["fate"][places] = 1
    return run_of(its)


def test_dropouts_are_counted_and_their_rows_measured() -> None:
    run = dropping([200, 201, 203])
    run.assert_dropouts_handled(at_least=3, in_a_row_max=2)
    counts = "3 lost, 0 late, 0 stale, 0 missed"
    assert told(lambda: run.assert_dropouts_handled(at_least=4)) == (
        f"axis1: {counts} in 500 cycles, at least 4 dropouts are needed to show how they are handled{PLACE}"
    )
    assert told(lambda: run.assert_dropouts_handled(in_a_row_max=1)) == (
        f"axis1: 2 readings lost in a row, the last at 0.201 s, at most 1 asked for ({counts}){PLACE}"
    )
    dropping([]).assert_dropouts_handled(at_least=0, in_a_row_max=0)


def test_a_cycle_without_a_set_point_is_told() -> None:
    its = rows()
    its["fate"][200], its["command_handed_at"][[210, 211]] = 2, NOTHING
    assert told(run_of(its).assert_dropouts_handled) == (
        "axis1: no set-point was sent in 2 of 500 cycles, first at 0.210 s "
        f"(0 lost, 1 late, 0 stale, 0 missed){PLACE}"
    )


def test_a_drive_that_leaves_its_state_is_told_when() -> None:
    its = rows()
    its["fate"][0] = 1
    its["statusword"][400:] = FAULT
    run = run_of(its)
    assert told(lambda: run.assert_stayed(State.OPERATION_ENABLED)) == (
        f"axis1: 'fault' at 0.400 s, 'operation enabled' expected{PLACE}"
    )
    assert told(run.assert_dropouts_handled).startswith("axis1: 'fault' at 0.400 s")
    its["statusword"][400:] = NOTHING
    assert told(lambda: run_of(its).assert_stayed(State.OPERATION_ENABLED)) == (
        f"axis1: no state of CiA 402 at 0.400 s, 'operation enabled' expected{PLACE}"
    )
    its["fate"] = 1
    assert told(lambda: run_of(its).assert_stayed(State.FAULT)) == f"axis1: no reading tells a state{PLACE}"


@pytest.mark.parametrize(("by_s", "reached"), [(None, True), (0.4, True), (0.3999, False)])
def test_a_state_is_reached_by_its_time(by_s: float | None, reached: bool) -> None:
    its = rows()
    its["statusword"][400:] = FAULT
    run = run_of(its)
    run.events.extend(
        [
            {"at_ns": -2_000_000_000, "track": "axis1 drive", "state": "Ready to switch on"},
            {"at_ns": -1_000_000_000, "track": "axis2 drive", "state": "Fault"},
            {"at_ns": 0, "level": "INFO", "text": "no state"},
        ]
    )
    if reached:
        run.assert_reached(State.FAULT, by_s=by_s)
        return
    seen = "ready to switch on at -2.000 s, operation enabled at 0.000 s, fault at 0.400 s"
    assert told(lambda: run.assert_reached(State.FAULT, by_s=by_s)) == (
        f"axis1: in 'fault' at 0.400 s, at 0.3999 s asked for; it was seen {seen}{PLACE}"
    )
    its["fate"] = 1
    assert told(lambda: run_of(its).assert_reached(State.FAULT)) == (
        f"axis1: never in 'fault'; it was seen in no state{PLACE}"
    )


def test_foreign_syncs_are_unintended_but_where_the_bench_hears_them() -> None:
    sync = SeenFrame(Instant(0), False, 0x080, b"")
    run = run_of(rows())
    run.wire.frames.append(sync)
    assert told(run.assert_no_unintended_frame) == (
        f"1 unintended of 1 frames:\n  0.000000 s received 080# (SYNC){PLACE}"
    )
    run.assert_no_unintended_frame(allow=("080#",))
    loop = BENCH.loop.model_copy(update={"sync": "heard"})
    heard = Run(BENCH.model_copy(update={"loop": loop}), Path("nowhere"))
    vars(heard)["wire"] = Wire(frames=[sync])
    heard.assert_no_unintended_frame()


def test_an_axis_is_named_where_there_are_several() -> None:
    run = run_of(rows())
    assert run.axis().name == run.axis("axis1").name == "axis1"
    with pytest.raises(ValueError, match=r"^axis 'axis2': say one of axis1$"):
        run.axis("axis2")


def test_a_recording_is_read_when_it_is_asked_for(tmp_path: Path) -> None:
    writer = RecordsWriter(tmp_path / "records.arrow")
    writer.begin({"channels": json.dumps({"axis1": ["load", "gain"]})}, Instant(0))
    its = rows()
    its["channel_1"] = np.arange(CYCLES)
    writer.write(its)
    writer.close()
    write_summary(tmp_path, summary())
    events = [{"at_ns": 5, "text": "later"}, {"at_ns": -5, "text": "sooner"}]
    (tmp_path / "events.jsonl").write_text("\n".join(map(json.dumps, events)))
    Sealer(tmp_path).finish()
    error = BusDown("the bus is down")
    run = Run(BENCH, tmp_path, error)
    assert (run.folder, run.error, run.place) == (tmp_path, error, f"\nrecording: {tmp_path}")
    assert run.summary == summary()
    assert [event["text"] for event in run.events] == ["sooner", "later"]
    assert run.column("sequence").tolist() == list(range(1, CYCLES + 1))
    assert run.rows["due_at"].tolist() == [NS_PER_MS * number for number in range(CYCLES)]
    assert run.axis().channel("gain").tolist() == list(range(CYCLES))
    with pytest.raises(ValueError, match=r"^channel 'x': axis1 has load, gain$"):
        run.axis().channel("x")
    with pytest.raises(ValueError, match=r"^column 'x': there are sequence, axis, "):
        run.column("x")
    own = Run(BENCH, tmp_path, summary=replace(summary(), seed=9))
    assert own.summary.seed == 9


def test_a_history_tells_stretches_gaps_and_what_came_of_readings() -> None:
    its = rows()
    its["fate"][[0, 10, 11, 12, CYCLES - 1]] = [1, 2, 3, 4, 1]
    its["compute_ns"] = 15_500
    its["compute_ns"][3] = NOTHING
    history = AxisHistory("axis1", its)
    assert (history.readings_lost().most, history.readings_lost().at) == (3, 12_000_000)
    assert history.dropouts() == {"lost": 2, "late": 1, "stale": 1, "missed": 1}
    assert history.stretches() == [
        Stretch(100, 300, 0.1, "the reference of 100 rad/s (954.9 r/min)"),
        Stretch(300, 500, 0.3, "the load of 0.5 N m"),
    ]
    assert (history.compute_us[0], np.isnan(history.compute_us[3])) == (15.5, True)
    assert np.isnan(history.velocity_rad_s[[0, 10]]).all()
    assert history.error_rad_s[200] == 1.0
    assert history.window(0.009, 0.014).nonzero()[0].tolist() == [9, 13]
    assert history.scale_rad_s == 100.0
    with pytest.raises(ValueError, match=r"^channel 'x': axis1 has none$"):
        history.channel("x")
    assert AxisHistory("axis1", its[:0]).scale_rad_s == 0.0


def test_a_change_in_the_first_cycle_counts_and_one_of_a_single_cycle_does_not() -> None:
    its = rows()
    its["reference_rad_s"] = -50.0
    its["load_torque_nm"] = 0.0
    its["reference_rad_s"][200] = 10.0
    found = AxisHistory("axis1", its).stretches()
    assert [(each.first, each.end) for each in found] == [(0, 200), (201, 500)]
    assert found[0].what == "the reference of -50 rad/s (-477.5 r/min)"
    assert AxisHistory("axis1", its).scale_rad_s == 50.0
