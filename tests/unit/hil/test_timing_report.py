"""What a run says its timing rests on, and from when on that is not to be trusted."""

from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.timebase import Duration
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.execution.conclusion import distrust, timing_report
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.syncs import SyncLog

PERIOD: Final = Duration(1_000_001)


def health(**counts: int) -> Any:
    names = ("placed", "duplicates", "unmatched", "error_ns_max", "stamp_error_ns_max", "steps")
    return SimpleNamespace(
        **dict.fromkeys((*names, "below_transit", "before_sync", "two_stamps"), 0) | counts
    )


def axis(stamped: Any = None, ordered: Any = None, ready: bool = False, coarse: bool = False) -> Axis:
    clock = SimpleNamespace(ready=ready, offset_ns=-2_500, error_ns=1_500, drift_ppm=3.0, drift_error_ppm=0.5)
    made = SimpleNamespace(
        parts=SimpleNamespace(name="axis1"),
        by_stamp=SimpleNamespace(
            health=stamped or health(), clock=clock, stamps=SimpleNamespace(coarse=coarse)
        ),
        by_order=SimpleNamespace(health=ordered or health()),
        meter=SimpleNamespace(unmatched=100),
        commands=SimpleNamespace(unexplained=7),
        readbacks=SimpleNamespace(unordered=8),
        uncertain=9,
    )
    return cast(Axis, made)


def test_all_of_it_is_told() -> None:
    log = cast(SyncLog, SimpleNamespace(basis=EchoBasis.KERNEL, surplus=3, crowded=4))
    stamped = health(placed=50, duplicates=1, unmatched=10, error_ns_max=1_500, steps=2)
    ordered = health(placed=5, duplicates=20, unmatched=1_000, error_ns_max=700)
    report = timing_report([axis(stamped, ordered)], {"simulated": log}, {"node 5 started": 2})
    expected = {
        "placed": 55,
        "by_order": 5,
        "uncertain": 9,
        "duplicates": 21,
        "unmatched": 1_110,
        "error_us_max": 1.5,
        "clock_steps": 2,
        "commands_unexplained": 7,
        "readbacks_unordered": 8,
    }
    assert report == {
        "sync": {"simulated": {"basis": EchoBasis.KERNEL.value, "surplus": 3, "crowded": 4}},
        "axes": {"axis1": expected},
        "others": {"node 5 started": 2},
    }
    clock = {"offset_us": -2.5, "error_us": 1.5, "drift_ppm": 3.0, "drift_error_ppm": 0.5}
    ready = timing_report([axis(stamped, ordered, ready=True)], {})
    assert ready == {"sync": {}, "axes": {"axis1": expected | {"clock": clock}}, "others": {}}


@pytest.mark.parametrize(
    ("counts", "doubt"),
    [
        ({}, None),
        ({"below_transit": 1}, "1 readings came sooner than their frame takes on the wire"),
        ({"before_sync": 2}, "2 readings came before their SYNC"),
        ({"two_stamps": 3}, "3 SYNCs have two different stamps"),
    ],
)
def test_what_cannot_be_is_a_doubt(counts: dict[str, int], doubt: str | None) -> None:
    expected = () if doubt is None else (f"axis1: {doubt}",)
    assert distrust([axis(health(**counts))], PERIOD) == expected
    assert distrust([axis(None, health(**counts))], PERIOD) == expected
    assert distrust([axis(), axis(health(**counts), health(**counts))], PERIOD) == 2 * expected


def test_a_stamp_that_does_not_say_which_cycle_it_was_is_a_doubt_and_order_says_it() -> None:
    doubt = "axis1: a sampling instant is known to 500 us only, more than half a period"
    assert distrust([axis(health(stamp_error_ns_max=500_000))], PERIOD) == ()
    assert distrust([axis(health(stamp_error_ns_max=500_001))], PERIOD) == (doubt,)
    assert distrust([axis(health(stamp_error_ns_max=500_001), coarse=True)], PERIOD) == (), "it is known to"
    assert distrust([axis(None, health(stamp_error_ns_max=900_000))], PERIOD) == ()
