"""What a test may claim about a run: true of the runs it is true of, false of those made for it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.testing.run import Run
from servobench.hil.testing.wire import SeenFrame, Wire
from tests.unit.hil.test_report import summary

BENCH = Path(__file__).parents[3] / "examples" / "ling2012.toml"
ENABLED, FAULT = 0x0237, 0x0218
CYCLES = 1000
STEP_AT, LOAD_AT = 100, 600
REFERENCE = 100.0


def rows_of(error: Callable[[int], float]) -> Rows:
    """1 s at 1 kHz: a step of reference and one of load; ``error``: of the speed, by cycle."""
    rows = np.zeros(CYCLES, ROW_DTYPE)
    number = np.arange(CYCLES)
    errors = np.array([error(place) for place in range(CYCLES)])
    rows["sequence"] = number + 1
    rows["due_at"] = number * NS_PER_MS
    rows["reference_rad_s"] = np.where(number >= STEP_AT, REFERENCE, 0.0)
    rows["load_torque_nm"] = np.where(number >= LOAD_AT, 0.5, 0.0)
    rows["velocity_rad_s"] = rows["reference_rad_s"] - errors
    rows["statusword"] = ENABLED
    return rows


def decaying(place: int) -> float:
    """Out of a band of 2 rad/s for 50 ms after the step, for 20 ms after the load."""
    if place < STEP_AT:
        return 0.0
    if place < LOAD_AT:
        return 50.0 if place < STEP_AT + 50 else 1.0
    return -5.0 if place < LOAD_AT + 20 else -0.5


def run_of(rows: Rows, passed: bool = True, completed: bool = True) -> Run:
    """A run with these records and no files."""
    run = Run(load_bench(BENCH), Path("nowhere"))
    found = summary(passed=passed, completed=completed)
    vars(run).update(rows=rows, summary=found, events=[])
    return run


def test_settling_is_measured_after_each_change() -> None:
    run = run_of(rows_of(decaying))
    assert run.assert_settles(within_s=0.1) == pytest.approx([0.049, 0.019])
    assert run.assert_settles(within_s=0.02, after_s=0.6) == pytest.approx([0.019])


def test_a_speed_that_settles_too_late_is_told_with_its_figures() -> None:
    run = run_of(rows_of(decaying))
    told = (
        r"axis1: 0.04 s after the reference of 100 rad/s \(954.9 r/min\) at 0.100 s the speed is still up to "
        r"50 % \(50 rad/s\) off, the band is 2 %; last outside of it after 0.049 s"
    )
    with pytest.raises(AssertionError, match=told):
        run.assert_settles(within_s=0.04)
    with pytest.raises(AssertionError, match=r"after the load of 0.5 N m at 0.600 s"):
        run.assert_settles(within_s=0.01, after_s=0.6)


def test_a_speed_that_leaves_the_band_again_has_not_settled() -> None:
    def relapsing(place: int) -> float:
        return 3.0 if place == LOAD_AT - 1 else decaying(place)

    run_of(rows_of(relapsing)).assert_settles(within_s=0.1, band_percent=3.0)
    with pytest.raises(AssertionError, match=r"last outside of it after 0.499 s"):
        run_of(rows_of(relapsing)).assert_settles(within_s=0.1)


def test_settling_needs_something_to_settle() -> None:
    run = run_of(rows_of(decaying))
    with pytest.raises(AssertionError, match=r"no stretch of 0.6 s after a change"):
        run.assert_settles(within_s=0.6)
    with pytest.raises(ValueError, match=r"nothing changes at 0.3 s; changes end at 0.100 s, 0.600 s"):
        run.assert_settles(within_s=0.1, after_s=0.3)
    still = rows_of(lambda _place: 0.0)
    still["reference_rad_s"] = 0.0
    with pytest.raises(ValueError, match="no reference to take percent of"):
        run_of(still).assert_settles(within_s=0.1)
    dropped = rows_of(decaying)
    dropped["fate"][STEP_AT + 90 :] = 1
    with pytest.raises(AssertionError, match="there is no reading any more"):
        run_of(dropped).assert_settles(within_s=0.1)


def test_a_ramp_is_a_change_that_ends_where_it_ends() -> None:
    rows = rows_of(lambda _place: 0.0)
    ramp = np.clip((np.arange(CYCLES) - STEP_AT) / 200.0, 0.0, 1.0) * REFERENCE
    rows["reference_rad_s"] = ramp
    rows["velocity_rad_s"] = ramp
    assert [stretch.at_s for stretch in run_of(rows).axis().stretches()] == pytest.approx([0.3, 0.6])


def test_errors_in_percent_in_rad_s_and_rms() -> None:
    run = run_of(rows_of(decaying))
    run.assert_error_below(percent=50.0)
    run.assert_error_below(rad_s=1.0, from_s=0.15, until_s=0.6)
    with pytest.raises(AssertionError, match=r"speed error 50 % \(50 rad/s at 0.100 s\), at most 49 %"):
        run.assert_error_below(percent=49.0)
    with pytest.raises(AssertionError, match=r"speed error 5 rad/s at 0.600 s, at most 4 rad/s"):
        run.assert_error_below(rad_s=4.0, from_s=0.15)
    rms = np.sqrt((50 * 50.0**2 + 450 + 20 * 5.0**2 + 380 * 0.25) / CYCLES)
    run.assert_error_below(rms_rad_s=rms * 1.001)
    with pytest.raises(AssertionError, match=r"11.23 rad/s rms \(peak 50 rad/s at 0.100 s\)"):
        run.assert_error_below(rms_rad_s=rms * 0.999)
    with pytest.raises(AssertionError, match="no reading between 2 s and 3 s"):
        run.assert_error_below(percent=1.0, from_s=2.0, until_s=3.0)
    with pytest.raises(ValueError, match="at least one"):
        run.assert_error_below()


def test_a_dropped_reading_says_nothing_about_the_speed() -> None:
    rows = rows_of(decaying)
    rows["velocity_rad_s"][700] = 1e6
    rows["fate"][700] = 2
    run_of(rows).assert_error_below(percent=50.0)


def dropping() -> Rows:
    rows = rows_of(decaying)
    rows["fate"][[200, 300, 301, 302]] = [1, 2, 3, 1]
    return rows


def test_dropouts_that_are_lived_with() -> None:
    run = run_of(dropping())
    run.assert_dropouts_handled(at_least=4, in_a_row_max=3)
    with pytest.raises(AssertionError, match="2 lost, 1 late, 1 stale, 0 missed in 1000 cycles, at least 5"):
        run.assert_dropouts_handled(at_least=5)
    with pytest.raises(AssertionError, match=r"3 readings lost in a row, the last at 0.302 s, at most 2"):
        run.assert_dropouts_handled(in_a_row_max=2)
    with pytest.raises(AssertionError, match="at least 1 dropouts are needed"):
        run_of(rows_of(decaying)).assert_dropouts_handled()


def test_dropouts_that_are_not() -> None:
    rows = dropping()
    rows["command_handed_at"][301] = NOTHING
    with pytest.raises(AssertionError, match=r"no set-point was sent in 1 of 1000 cycles, first at 0.301 s"):
        run_of(rows).assert_dropouts_handled()
    rows = dropping()
    rows["statusword"][900:] = FAULT
    with pytest.raises(AssertionError, match=r"'fault' at 0.900 s, 'operation enabled' expected"):
        run_of(rows).assert_dropouts_handled()
    with pytest.raises(AssertionError, match="the run was cut short: lost the bus"):
        run_of(dropping(), completed=False).assert_dropouts_handled()


def test_states_by_readings_and_by_events() -> None:
    rows = rows_of(decaying)
    rows["statusword"][500:] = FAULT
    run = run_of(rows)
    run.events.append({"at_ns": -1_000_000_000, "track": "axis1 drive", "state": "Switched on"})
    run.assert_reached(State.SWITCHED_ON)
    run.assert_reached(State.FAULT, by_s=0.5)
    with pytest.raises(AssertionError, match=r"in 'fault' at 0.500 s, at 0.4 s asked for"):
        run.assert_reached(State.FAULT, by_s=0.4)
    told = "never in 'quick stop active'; it was seen switched on at -1.000 s, operation enabled at 0.000 s"
    with pytest.raises(AssertionError, match=told):
        run.assert_reached(State.QUICK_STOP)


def test_a_verdict_names_the_limits_that_were_not_kept() -> None:
    run_of(rows_of(decaying)).assert_passed()
    with pytest.raises(AssertionError, match=r"^not passed: \w+ = [\d.]+, found [\d.]+"):
        run_of(rows_of(decaying), passed=False).assert_passed()


def test_an_axis_that_is_not_there_is_a_mistake_of_the_test() -> None:
    with pytest.raises(ValueError, match="say one of axis1"):
        run_of(rows_of(decaying)).assert_error_below(percent=1.0, axis="axis2")


def test_every_claim_that_fails_names_the_recording_once() -> None:
    run = run_of(rows_of(decaying), passed=False)
    claims: list[Callable[[], object]] = [
        run.assert_passed,
        lambda: run.assert_settles(within_s=0.01),
        lambda: run.assert_error_below(percent=1),
        run.assert_dropouts_handled,
        lambda: run.assert_reached(State.FAULT),
        lambda: run.assert_stayed(State.FAULT),
        run.assert_no_unintended_frame,
        lambda: run.wire.assert_seen("181#*"),
        lambda: run.wire.assert_none("7E5#*"),
    ]
    vars(run)["wire"] = Wire(
        frames=[SeenFrame(Instant(0), True, 0x7E5, bytes(8), False, False)], recording=run.folder
    )
    for claim in claims:
        with pytest.raises(AssertionError) as caught:
            claim()
        assert str(caught.value).count("recording: nowhere") == 1, str(caught.value)
