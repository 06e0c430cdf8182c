"""A controller's network against the one of a run: before anything moves, and record by record."""

from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import BadInput, BenchError, LimitExceeded
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.controller_files import MadeFor
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.configuration.network_file import Network
from servobench.hil.execution.network_guard import Allowed, Certificates, NetworkGuard, allowed
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.samples import (
    CommandFate,
    Dropout,
    DropoutCause,
    Observation,
    Sample,
    Sending,
)
from servobench.hil.studies.speed.controller_text import plant_of
from tests.unit.hil.loop_fakes import reading_at
from tests.unit.hil.row_tools import cycle_record

PERIOD = Duration(2_000_000)
LIMITS = Allowed(3, Duration(1_000_000), Duration(9_000_000))
MADE_FOR: dict[str, Any] = {
    "delay_us": 9_000,
    "strategy": "arrival",
    "period_us": 2_000,
    "losses_in_a_row_max": 3,
    "delay_max_us": 1_000,
    "plant": plant_of(LING2012.parameters).model_dump(),
    "current_loop": {"bandwidth_hz": 800.0, "bandwidth_min_hz": 500.0, "bandwidth_max_hz": 1200.0},
}


def bench(made_for: dict[str, Any], actuation: str = "on_arrival", **drive: Any) -> BenchConfig:
    tables: dict[str, Any] = {
        "bench": {"name": "x", "duration_s": 1.0},
        "loop": {"period_us": 2000, "actuation": actuation},
        "drive": {
            "axis1": {
                "node": 1,
                "motor": LING2012.model_dump(mode="json"),
                "limits": {"speed_max_rpm": 2000.0, "torque_max_nm": 5.0},
                "controller": {"kind": "state_feedback", "gain": [0.0, -0.1], "made_for": made_for},
                **drive,
            }
        },
    }
    return bench_from(tables, "bench.toml", Path())


def record(sequence: int, delay_us: int | None) -> CycleRecord:
    """A cycle whose reading acts ``delay_us`` after its sample, or is lost."""
    sampled = sequence * PERIOD
    delay = 0 if delay_us is None else delay_us * 1000
    observation: Observation = Dropout(sequence, Instant(sampled), DropoutCause.LOST, True)
    if delay_us is not None:
        reading = reading_at(Instant(sampled + delay - 200_000))
        observation = Sample(sequence, reading, Instant(sampled), 0, True)
    effective = Instant(sampled + delay)
    return cycle_record(
        sequence=sequence,
        axis=0,
        due_at=Instant(sampled),
        woke_at=None,
        sync_handed_at=None,
        sync_on_bus_at=Instant(sampled),
        observation=observation,
        delay=Duration(delay),
        estimate=None,
        reference_rad_s=0.0,
        load_torque_nm=0.0,
        clock_offset_ns=None,
        clock_error_ns=None,
        command=Command(sequence, 0.0, effective, Instant(effective + PERIOD)),
        sending=Sending(0, Instant(effective - 100_000), effective, CommandFate.NOT_MEASURED, None, None),
    )


class Watched:
    def __init__(self, refuse: bool = True, stopping: bool = False, limits: Allowed = LIMITS) -> None:
        self.records: list[CycleRecord] = []
        self.told: list[str] = []
        self.guard = NetworkGuard(
            "axis1", limits, PERIOD, self.records.append, refuse,
            self.told.append, lambda: stopping,
        )  # fmt: skip

    def feed(self, *delays_us: int | None) -> None:
        for sequence, delay_us in enumerate(delays_us):
            self.guard(record(sequence, delay_us))


def test_a_network_within_its_bounds_passes() -> None:
    watched = Watched()
    watched.feed(1000, None, None, None, 300, None, 1000)
    assert len(watched.records) == 7


@pytest.mark.parametrize(
    ("delays_us", "found"),
    [((500, None, None, None, None), "4 readings lost in a row"), ((500, 1001), "1001.0 us from sample")],
)
def test_a_worse_network_stops_the_run_after_its_record_is_kept(
    delays_us: tuple[int | None, ...], found: str
) -> None:
    watched = Watched()
    with pytest.raises(LimitExceeded) as caught:
        watched.feed(*delays_us)
    assert found in str(caught.value)
    assert "--allow-uncertified" in str(caught.value)
    assert len(watched.records) == len(delays_us)


def test_with_the_flag_each_kind_is_told_once() -> None:
    watched = Watched(refuse=False)
    watched.feed(*[None] * 9, 1500, 1500, *[None] * 9)
    assert len(watched.records) == 20
    assert len(watched.told) == 2


def test_readings_lost_by_stopping_do_not_count() -> None:
    watched = Watched(stopping=True)
    watched.feed(*[None] * 9)
    assert watched.told == []


def test_the_controller_brings_its_compensator() -> None:
    assert bench(MADE_FOR).drive["axis1"].compensator.kind == "arrival"
    stamp = bench(MADE_FOR | {"strategy": "stamp", "agreed_delay_us": 10_000}, "on_sync")
    found = stamp.drive["axis1"].compensator
    assert found.kind == "stamp"
    assert found.delay_us == 10_000
    assert Certificates(stamp).faults({}) == []


def test_history_needs_packets_that_the_bus_does_not_carry() -> None:
    with pytest.raises(BenchError, match="history"):
        bench(MADE_FOR | {"strategy": "history", "agreed_delay_us": 9_000})


def test_a_bench_as_it_was_made_for_has_no_faults() -> None:
    config = bench(MADE_FOR)
    assert Certificates(config).faults({}) == []
    good = Network(period_us=2000, losses_in_a_row_max=3, delay_max_us=1000)
    assert Certificates(config).faults({"n.toml": good}) == []


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"period_us": 1000}, "period_us"),
        ({"plant": MADE_FOR["plant"] | {"inertia_kg_m2": 0.001}}, "plant.inertia_kg_m2"),
    ],
)
def test_another_period_or_motor_is_a_fault(change: dict[str, Any], key: str) -> None:
    faults = Certificates(bench(MADE_FOR | change)).faults({})
    assert [fault.key for fault in faults] == [f"drive.axis1.controller.made_for.{key}"]


def test_another_compensator_is_a_fault() -> None:
    config = bench(MADE_FOR, "on_sync", compensator={"kind": "stamp", "delay_us": 4000})
    (fault,) = Certificates(config).faults({})
    assert fault.key.endswith("strategy")
    assert Certificates(config, {"axis1"}).faults({}) == []


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"losses_in_a_row_max": 4}, "network.losses_in_a_row_max"),
        ({"command_losses_in_a_row_max": 1}, "network.losses_in_a_row_max"),
        ({"delay_max_us": 1001}, "network.delay_max_us"),
        ({"period_us": 1000}, "network.period_us"),
    ],
)
def test_a_worse_measured_network_is_a_fault(change: dict[str, int], key: str) -> None:
    wanted = {"period_us": 2000, "losses_in_a_row_max": 3, "delay_max_us": 1000, **change}
    network = Network.model_validate(wanted)
    (fault,) = Certificates(bench(MADE_FOR)).faults({"n.toml": network})
    assert (fault.source, fault.key) == ("n.toml", key)


def test_nothing_is_held_against_a_network_whose_commands_are_not_measured() -> None:
    network = Network(period_us=2000, losses_in_a_row_max=0, delay_max_us=300, commands="not measured")
    (fault,) = Certificates(bench(MADE_FOR)).faults({"n.toml": network})
    assert (fault.source, fault.key, fault.value) == ("n.toml", "network.commands", "not measured")
    assert "6074h" in fault.remedy
    assert 'commands = "stated"' in fault.remedy
    assert Certificates(bench(MADE_FOR), {"axis1"}).faults({"n.toml": network}) == []


def test_what_a_constant_delay_allows() -> None:
    # (D + 1) h + T within 9 ms at h = 2 ms: three losses with 1 ms of delay, or none with 7 ms
    limits = allowed(MadeFor(delay_us=9_000), PERIOD)
    assert limits == Allowed(3, Duration(7_000_000), Duration(9_000_000))
    watched = Watched(limits=limits)
    watched.feed(1000, None, None, None, 1000, 7000)
    with pytest.raises(LimitExceeded, match=r"acts for 9001\.0 us"):
        watched.feed(1000, None, None, None, 1001)
    config = bench({"delay_us": 9_000})
    fits, fails = (Network(period_us=2000, losses_in_a_row_max=2, delay_max_us=us) for us in (3000, 3001))
    assert Certificates(config).faults({"n.toml": fits}) == []
    assert [fault.key for fault in Certificates(config).faults({"n.toml": fails})] == ["network"]


def test_current_loops_faster_than_their_rate_allows_are_refused() -> None:
    with pytest.raises(BenchError, match="current_bandwidth_hz"):
        bench(MADE_FOR, simulation={"current_bandwidth_hz": 2001.0})
    assert bench(MADE_FOR, simulation={"current_bandwidth_hz": 2000.0}).axes == ("axis1",)


@pytest.mark.parametrize(
    ("simulation", "key"),
    [
        ({"current_bandwidth_hz": 1201.0}, "current_bandwidth_hz"),
        ({"current_bandwidth_hz": 499.0}, "current_bandwidth_hz"),
        ({"inner_rate_hz": 8_000}, "inner_rate_hz"),
    ],
)
def test_a_current_loop_that_is_not_certified_is_a_fault(simulation: dict[str, float], key: str) -> None:
    (fault,) = Certificates(bench(MADE_FOR, simulation=simulation)).faults({})
    assert (fault.source, fault.key) == ("bench.toml", f"drive.axis1.simulation.{key}")
    assert "500 to 1200 Hz" in fault.expected
    assert "--allow-uncertified" in fault.remedy


def test_a_controller_that_names_no_current_loop_is_for_the_winding_alone() -> None:
    winding = {key: value for key, value in MADE_FOR.items() if key != "current_loop"}
    (fault,) = Certificates(bench(winding)).faults({})
    assert fault.key == "drive.axis1.simulation.inner_rate_hz"
    assert fault.value == "800 Hz"
    assert "53.832 Hz and no other" in fault.expected
    assert Certificates(bench(winding, simulation={"current_bandwidth_hz": 53.83})).faults({}) == []


def test_a_loop_of_higher_order_is_not_what_was_certified() -> None:
    """K = 100 (s + 338)/(s (s + 3000)) V/A on a winding of 2.875 Ohm and 8.5 mH."""
    q = {
        "kind": "continuous",
        "axis": "q",
        "gain": 1.2e5,
        "zeros_rad_s": [[-338.0, 0.0]],
        "poles_rad_s": [[0.0, 0.0], [-3000.0, 0.0]],
    }
    (fault,) = Certificates(bench(MADE_FOR, current_control={"controller": q})).faults({})
    assert fault.key == "drive.axis1.current_control.controller"
    assert "of order 3" in str(fault.value)


REAL = "socketcan:can0"
COMMISSIONED: dict[str, Any] = {"drive": {"node": 1, "vendor": 0, "product": 0}}


def test_a_drive_that_is_not_simulated_is_known_by_its_commissioning() -> None:
    """The settings of the simulated drive say nothing of a real one."""
    simulation = {"current_bandwidth_hz": 100.0}
    blind = bench(MADE_FOR, simulation=simulation)
    assert Certificates(blind.as_run(REAL, None)).faults({}) == []
    (unknown,) = Certificates(blind.as_run(REAL, None)).doubts()
    assert "500 to 1200 Hz" in unknown
    assert "hil commission" in unknown

    measured = COMMISSIONED | {"current_loop": {"bandwidth_hz": 300.0}}
    (fault,) = Certificates(bench(MADE_FOR, commissioned=measured).as_run(REAL, None)).faults({})
    assert fault.key == "drive.axis1.commissioned.current_loop.bandwidth_hz"
    assert fault.value == "300 Hz"
    measured = COMMISSIONED | {"current_loop": {"bandwidth_hz": 600.0}}
    fits = bench(MADE_FOR, commissioned=measured, simulation=simulation)
    assert Certificates(fits.as_run(REAL, None)).faults({}) == []
    assert Certificates(fits.as_run(REAL, None)).doubts() == []


def test_what_is_not_certified_may_be_let_pass() -> None:
    config = bench(MADE_FOR, simulation={"current_bandwidth_hz": 1300.0})
    certificates = Certificates(config)
    with pytest.raises(BadInput, match="1300 Hz"):
        certificates.check(None, allow=False)
    certificates.check(None, allow=True)
    (note,) = certificates.notes
    assert "1300 Hz" in note
