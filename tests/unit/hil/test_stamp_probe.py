"""What ``hil measure`` finds of a stamp, beside the settings of the simulated drive that made it."""

from random import Random
from typing import Any

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.measuring.stamp_probe import StampFigures, find_stamp
from servobench.hil.terminal.measure_report import stamp_text
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.draws import few_of
from tests.motors import LING

KEY = (0x1013, 0)


def found(seed: int = 0, **keys: Any) -> StampFigures | None:
    servo = SimulatedServo(1, LING, DriveParameters(**keys), seed)
    plan = WorldPlan(parse_bus_spec("simulated", "--bus"), 1_000_000, seed=seed)
    with open_world(plan, [servo]) as world:
        return find_stamp(CanopenNetwork(world.link, world.clock), 1, KEY, seed)


@pytest.mark.parametrize("seed", few_of(range(24), 8))
def test_the_drawn_settings_of_a_drive_are_found(seed: int) -> None:
    draw = Random(f"settings {seed}")
    unit_us = draw.choice((0.5, 1.0, 1.0, 1.0, 10.0, 100.0))
    keys: dict[str, Any] = {
        "stamp_unit_us": unit_us,
        "stamp_resolution_us": unit_us * draw.randint(1, max(1, min(400, int(1000 / unit_us)))),
        "stamp_bits": draw.choice((32, 32, 24, 16)),
        "stamp_latched": draw.choice(("sampling", "arrival")),
        "stamp_late_us": draw.choice((0.0, 40.0)),
        "sync_jitter_us": draw.choice((0.0, 200.0)),
        "clock_drift_ppm": draw.uniform(-500, 500),
    }
    figures = found(seed, **keys)
    assert figures is not None
    assert (figures.runs, figures.at_sync) == (True, keys["stamp_latched"] == "arrival")
    assert (figures.unit_us, figures.resolution_us) == (unit_us, keys["stamp_resolution_us"])
    assert figures.bits in (None, keys["stamp_bits"])
    wraps_s = unit_us * 1e-6 * 2 ** keys["stamp_bits"]
    assert figures.bits is not None or wraps_s > 0.2


@pytest.mark.parametrize("rate_hz", [8000, 12_000, 16_000])
def test_ticks_that_are_no_whole_counts_are_found(rate_hz: int) -> None:
    figures = found(stamp_latched="tick", inner_rate_hz=rate_hz)
    assert figures is not None
    assert figures.resolution_us == pytest.approx(1e6 / rate_hz)


def test_a_counter_that_only_a_master_sets_does_not_run() -> None:
    figures = found(stamp_runs=False)
    assert figures is not None
    assert (figures.runs, figures.at_sync, figures.unit_us, figures.resolution_us) == (
        False,
        None,
        None,
        None,
    )


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        (
            {},
            "counts 1 us in steps of 1 us (for a bench: drive.NAME.stamp_resolution_us), did not wrap",
        ),
        ({"stamp_bits": 16}, "wraps at 16 bits; latched when it is asked for, how late cannot be told"),
        ({"stamp_latched": "arrival"}, "latched at the arrival of the SYNC"),
        ({"stamp_runs": False}, "stands still in 64 reads, a master sets it or nothing does; not used"),
        ({"stamp_unit_us": 0.7, "stamp_resolution_us": 0.7}, "counts in no unit that is known; not used"),
    ],
)
def test_what_was_found_is_told(keys: dict[str, Any], text: str) -> None:
    figures = found(**keys)
    assert figures is not None
    assert text in stamp_text(figures)


def test_a_drive_without_the_object_has_no_figures() -> None:
    assert found(lacks=("1013",)) is None
