"""6061h of a drive that has no room for it in a TPDO: it is read by SDO, and said where that ends."""

from typing import Any

from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.run import Run
from tests.scenario.test_drive_follows import (
    AT_S,
    CYCLES_MAX,
    PERIOD_NS,
    QUICK_STOP,
    events,
    mode_change,
    run,
)

SYNC_ONLY = {"drive.axis1.simulation.lacks": ["tpdo events"]}
"""The statusword comes with the SYNC, and takes the place of the mode."""
BY_SDO = "6061h by SDO every 50 ms; bit 12 of 6041h once it is set: it is 0"
"""As no statusword has come by PDO before the first cycle."""
EVERY_S = 0.05
SILENT_S = 0.5
GIVEN_UP_S = 0.2


def watch_of(ended: Run) -> Any:
    """As the summary tells it."""
    return next(drive.mode_watch for drive in ended.summary.drives)


def test_a_drive_that_leaves_its_mode_is_stopped_with_the_next_read(servo_bench: BenchRunner) -> None:
    """For a mode that sets bit 12, too: 6061h alone tells it."""
    ended, shaft = run(servo_bench, mode_change("csv"), SYNC_ONLY, ends=True)
    shows = ended.wire.find("581#4F61600009......", sent=False)[0]
    stop = ended.wire.find(QUICK_STOP, sent=True)[0]
    assert 0 < stop.at - shows.at <= CYCLES_MAX * PERIOD_NS
    asked = len(ended.wire.find("601#4061600000000000", sent=True))
    assert asked >= AT_S / EVERY_S
    assert len(ended.rows) * 1e-3 - AT_S <= EVERY_S + CYCLES_MAX * 1e-3
    assert watch_of(ended) == BY_SDO
    assert "left cyclic synchronous torque for cyclic synchronous velocity" in str(ended.error)
    assert abs(shaft.rpm(0.02)).max() < 1.0, "it rests"


def test_a_drive_that_does_not_answer_any_more_is_said_to_be_unwatched(servo_bench: BenchRunner) -> None:
    silent = {"side": "drive", "frames": ["sdo"], "direction": "host_to_drive", "from_s": AT_S}
    faults = {"blackout": [silent | {"duration_s": SILENT_S}]}
    ended, _ = run(servo_bench, faults, SYNC_ONLY, ends=False)
    told = [
        (at / 1e9, text.partition("its mode is watched by ")[2]) for at, text in events(ended, "its mode")
    ]
    first, (lost_s, lost), (again_s, again) = told
    assert first[1] == BY_SDO
    assert lost == "nothing, as 6061h, read by SDO every 50 ms, is not answered any more; bit 12 of 6041h"
    assert GIVEN_UP_S - EVERY_S <= lost_s - AT_S <= GIVEN_UP_S + EVERY_S
    assert 0.0 < again_s - AT_S - SILENT_S <= 3 * EVERY_S
    assert again == watch_of(ended)
    assert again == "6061h by SDO every 50 ms, which was not answered for a time; bit 12 of 6041h"


def test_a_drive_without_the_object_is_said_to_be_unwatched(servo_bench: BenchRunner) -> None:
    ended, _ = run(servo_bench, {}, {"drive.axis1.simulation.lacks": ["6061"]}, ends=False)
    assert watch_of(ended) == "nothing, as its 6061h cannot be read; bit 12 of 6041h"
    (said,) = (event for event in ended.events if "its mode" in event.get("text", ""))
    assert said["level"] == "WARN"
