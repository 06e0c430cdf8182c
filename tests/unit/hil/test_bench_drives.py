"""Drives of a bench: what each is told, how it is waited for, stopped, and what a recording knows of it."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.cia402.drive_setup import DriveSettings, Identity
from servobench.drivers.cia402.profile import BENCH_MODES, Mode, QuickStopOption
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import NoAnswer, PeerFault
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.assembly import (
    command_duration,
    command_latency,
    loop_timing,
    shortest_transit,
    sync_latency,
)
from servobench.hil.execution.drive_session import connect, data_sheets, drive_settings, stop_all
from servobench.hil.execution.recorded_bench import recording_plan, review_plan
from servobench.hil.loop.loop import Actuation
from servobench.hil.machine.stopping import Interrupted, StopRequest
from servobench.hil.rows.recording_plan import AxisPlan, CertifiedPlan, PlannedSetPoint
from tests.unit.hil.test_config import load, tables

Change = Callable[[dict[str, Any]], object]


def bench(**changes: Any) -> BenchConfig:
    """The example, with values in tables: ``loop__period_us=2000``."""
    raw = tables()
    for path, value in changes.items():
        *steps, last = path.split("__")
        node = raw
        for step in steps:
            node = node.setdefault(step, {})
        node[last] = value
    return load(raw)


def settings(config: BenchConfig) -> DriveSettings:
    return drive_settings(config, "axis1", loop_timing(config), None)


LIMITS: Final = {"speed_max_rpm": 2000.0, "torque_max_nm": 1.5}


def test_a_drive_is_told_what_the_bench_says_of_it() -> None:
    config = bench(
        drive__axis1__limits=LIMITS | {"quick_stop_deceleration_rpm_s": 6000.0},
        drive__axis1__heartbeat_ms=20,
        drive__axis1__heartbeat_timeout_ms=90,
        host__heartbeat_ms=30,
        host__heartbeat_timeout_ms=140,
        loop__position_every_cycles=4,
    )
    found = settings(config)
    assert found == DriveSettings(
        sync_period_ns=Duration(1_000_000),
        mode=Mode.CYCLIC_SYNCHRONOUS_TORQUE,
        coherent=config.coherent("axis1"),
        synchronous_command=False,
        position_every_cycles=4,
        demand_changes=False,
        observed=config.drive["axis1"].observed,
        command_timeout_ms=100,
        drive_heartbeat_ms=20,
        drive_heartbeat_timeout_ms=90,
        host_heartbeat_ms=30,
        host_heartbeat_timeout_ms=140,
        torque_max_nm=1.5,
        speed_max_rad_s=2000.0 * RAD_S_PER_RPM,
        quick_stop_deceleration_rad_s2=6000.0 * RAD_S_PER_RPM,
        quick_stop_option=QuickStopOption.QUICK_STOP_RAMP,
        capability=None,
        unwatched=False,
        scale=ScaleOverride(),
    )


@pytest.mark.parametrize(
    ("dropouts", "period_us", "timeout_ms"),
    [(100, 1000, 100), (10, 1000, 50), (51, 1000, 51), (149, 1000, 149), (200, 1000, 150), (51, 1001, 52)],
)
def test_commands_may_fail_to_come_for_as_long_as_readings(
    dropouts: int, period_us: int, timeout_ms: int
) -> None:
    """Between the host's heartbeats, 50 ms, and until it counts as lost, 150 ms."""
    limits = LIMITS | {"dropouts_consecutive_max": dropouts}
    config = bench(drive__axis1__limits=limits, loop__period_us=period_us)
    assert settings(config).command_timeout_ms == timeout_ms


def test_on_a_segment_a_frame_takes_its_bits() -> None:
    """Counted by hand: 44 bits and the data, stuff bits beside them, three bits after it."""
    # a SYNC is 0, 00010000000, 0, 0, 0, 0000 and 15 bits of CRC: a stuff bit after five equal ones
    assert sync_latency(1_000_000) == 48_000
    assert sync_latency(125_000) == 8 * 48_000
    assert [shortest_transit(size, 1_000_000) for size in (0, 4, 8)] == [44_000, 76_000, 108_000]
    for mode, data_bytes in (("cst", 4), ("csv", 6), ("csp", 6)):
        took = command_latency(500_000, mode)
        assert shortest_transit(data_bytes, 500_000) < took
        assert command_duration(500_000, mode) == took + 6_000
    assert command_latency(500_000) == command_latency(500_000, "cst")


@pytest.mark.parametrize(("sync", "own"), [("own", True), ("kernel", False)])
def test_the_times_of_a_loop_are_those_of_its_bench(sync: str, own: bool) -> None:
    config = bench(loop__sync=sync)
    timing = loop_timing(config)
    assert timing.period == config.loop.period
    assert timing.decide_after == config.loop.decide_after
    assert timing.settle == config.loop.deadline + config.loop.period
    assert timing.actuation is Actuation(config.loop.actuation)
    assert timing.sync_latency == (sync_latency(config.bus.bitrate_bit_s) if own else 0)
    assert timing.command_latency == command_latency(config.bus.bitrate_bit_s)


def test_axes_without_a_data_sheet_have_none() -> None:
    assert data_sheets(bench()) == {}


# ---- connecting and stopping --------------------------------------------------------------------------

IDENTITY: Final = Identity("it", 7, 8, 1, 9, 0)


class Slow:
    """A drive that answers at an instant of the test's choice, ms."""

    def __init__(self, answers_ms: float, at_once: bool = False) -> None:
        """``at_once``: where it does not answer, its transfers fail in no time."""
        self.now = Instant(0)
        self.asked_ms: list[float] = []
        self.network = self
        self.clock = SimpleNamespace(now=lambda: self.now)
        self._answers, self._at_once = Instant(round(answers_ms * NS_PER_MS)), at_once

    def deadline_after(self, limit: Duration) -> Instant:
        return Instant(self.now + limit)

    def pump(self, until: Instant) -> None:
        self.now = max(self.now, until)

    def connect(self, deadline: Instant) -> Identity:
        self.asked_ms.append(deadline / NS_PER_MS)
        if self._answers <= deadline:
            self.now = max(self.now, self._answers)
            return IDENTITY
        if not self._at_once:
            self.now = deadline
        raise NoAnswer("nothing came")


def connected(drive: Slow, timeout_s: float, stop: StopRequest | None = None) -> Identity:
    return connect(cast(ServoDrive, drive), timeout_s, stop or StopRequest())


@pytest.mark.parametrize("at_once", [False, True])
@pytest.mark.parametrize(
    ("answers_ms", "asked_ms"),
    [(10, [300]), (300, [300]), (301, [300, 600]), (1_000, [300, 600, 900, 1_000])],
)
def test_a_drive_is_asked_again_until_it_answers(
    answers_ms: float, asked_ms: list[float], at_once: bool
) -> None:
    drive = Slow(answers_ms, at_once)
    assert connected(drive, 1.0) == IDENTITY
    assert drive.asked_ms == asked_ms
    assert drive.now == answers_ms * NS_PER_MS


@pytest.mark.parametrize("at_once", [False, True])
def test_one_that_does_not_answer_in_time_is_told(at_once: bool) -> None:
    drive = Slow(1_001, at_once)
    with pytest.raises(NoAnswer):
        connected(drive, 1.0)
    assert drive.now == NS_PER_S
    assert drive.asked_ms[:4] == [300, 600, 900, 1_000]


def test_a_stop_signal_is_heard_before_a_drive_is_asked() -> None:
    drive, stop = Slow(10), StopRequest()
    stop.ask("SIGTERM")
    with pytest.raises(Interrupted, match="ended by SIGTERM"):
        connected(drive, 1.0, stop)
    assert drive.asked_ms == []


def test_all_drives_are_stopped_by_frames_before_any_is_asked() -> None:
    told: list[tuple[str, bool]] = []

    class Drive:
        def __init__(self, name: str) -> None:
            self.name = name

        def stop(self, *, asking: bool) -> None:
            told.append((self.name, asking))
            if self.name == "one":
                raise PeerFault("it is silent")

    stop_all(cast(list[ServoDrive], [Drive("one"), Drive("two")]))
    assert told == [("one", False), ("two", False), ("one", True), ("two", True)]


# ---- what a recording knows beforehand ----------------------------------------------------------------


def certified(torque_rms_nm_max: float | None) -> dict[str, CertifiedPlan]:
    return {"axis1": CertifiedPlan(1000, torque_rms_nm_max=torque_rms_nm_max)}


def test_the_review_knows_limits_and_motor_of_each_axis() -> None:
    config = bench(drive__axis1__limits=LIMITS, verdict__settling_ms=120, verdict__settling_band_percent=5.0)
    motor = config.drive["axis1"].motor.parameters
    plan = review_plan(config, certified(None), real_time=True)
    assert plan.axes == (
        AxisPlan(
            "axis1",
            1.5 / motor.inertia_kg_m2,
            motor.rated_torque_nm,
            certified(None)["axis1"],
            1.5,
            2000.0 * RAD_S_PER_RPM,
            "speed",
            "cst",
        ),
    )
    assert (plan.settling, plan.band_percent, plan.period) == (120 * NS_PER_MS, 5.0, config.loop.period)
    assert list(BENCH_MODES) == ["cst", "csv", "csp", "ip", "vl"]


@pytest.mark.parametrize(
    ("own", "of_file", "least"),
    [(None, None, None), (0.3, None, 0.3), (None, 0.2, 0.2), (0.3, 0.2, 0.2), (0.1, 0.2, 0.1)],
)
def test_of_several_bounds_of_the_torque_the_smallest_counts(
    own: float | None, of_file: float | None, least: float | None
) -> None:
    config = bench(verdict={} if own is None else {"torque_rms_nm_max": own})
    assert review_plan(config, certified(of_file), real_time=True).limits.torque_rms_nm_max == least


@pytest.mark.parametrize("real_time", [True, False])
def test_computing_is_judged_in_real_time_alone(real_time: bool) -> None:
    config = bench(verdict__compute_us_max=500.0)
    limits = review_plan(config, {}, real_time=real_time).limits
    assert limits == replace(config.verdict.limits, compute_us_max=500.0 if real_time else None)


def test_set_points_are_told_in_the_order_of_their_time() -> None:
    config = bench(
        reference={
            "axis1": [
                {"kind": "step", "at_s": 0.1, "speed_rpm": 100.0},
                {"kind": "step", "at_s": 0.5, "speed_rpm": 300.0},
            ]
        },
        load={"axis1": [{"kind": "step", "at_s": 0.3, "torque_nm": 0.2}]},
    )
    found = recording_plan(config, None, {}, {}, real_time=False).set_points
    described = [entry.describe() for entry in (*config.reference["axis1"], *config.load["axis1"])]
    assert found == (
        PlannedSetPoint(Duration(100 * NS_PER_MS), 0, f"axis1: reference {described[0]}"),
        PlannedSetPoint(Duration(300 * NS_PER_MS), 0, f"axis1: load {described[2]}"),
        PlannedSetPoint(Duration(500 * NS_PER_MS), 0, f"axis1: reference {described[1]}"),
    )


def test_a_recording_is_of_its_bench() -> None:
    config = bench(loop__period_us=2000, recording__frames=False)
    folder = Path("runs/x")
    plan = recording_plan(config, folder, {}, {}, real_time=True)
    assert (plan.folder, plan.name, plan.seed) == (folder, config.bench.name, config.bench.seed)
    assert (plan.bus, plan.real_time, plan.deadline) == (config.bus.spec, True, config.loop.deadline)
    assert plan.review == review_plan(config, {}, real_time=True)
    assert plan.bench_toml == config.resolved_text()
    assert (plan.frames, plan.segments, plan.period_us) == (False, (), 2000)
    assert plan.faults is (config.faults is not None)
    assert (plan.channels, plan.observed, json.loads(plan.sources)) == ({}, {}, {})
    drive = config.drive["axis1"]
    assert plan.notes == {
        "bus": config.bus.spec,
        "motor": drive.motor.motor.name,
        "controller": drive.controller.kind,
        "compensator": drive.compensator.kind,
    }
    assert recording_plan(config, None, {}, {}, real_time=False).bench_toml == ""


def test_what_differs_by_axis_is_told_of_each() -> None:
    raw = tables()
    raw["drive"]["axis2"] = {
        **raw["drive"]["axis1"],
        "node": 9,
        "controller": {"kind": "pid", "proportional_nm_s_rad": 0.5},
        "compensator": {"kind": "arrival"},
    }
    raw["drive"]["axis1"]["compensator"] = {"kind": "arrival"}
    config = load(raw)
    first, second = (config.drive[axis].controller.kind for axis in ("axis1", "axis2"))
    notes = recording_plan(config, None, {}, {}, real_time=False).notes
    assert notes["controller"] == (first if first == second else f"axis1 {first}, axis2 {second}")
    assert notes["compensator"] == "arrival"
