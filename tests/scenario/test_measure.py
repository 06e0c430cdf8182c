"""``hil measure`` in simulated time: what is injected on either side of the bus is what comes out."""

import json
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import BadInput, BusDown, DriveInFault, LimitExceeded
from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.cli import app
from servobench.hil.configuration.network_file import load_network
from servobench.hil.machine.stopping import Interrupted
from servobench.hil.measuring.figures import Measured, fault_plan_text
from servobench.hil.measuring.loss_model import Losses
from servobench.hil.measuring.stages import NO_CLOCK, NO_DEMAND, NOT_ENABLED, Stage
from servobench.hil.restoring.journal import read_journal
from servobench.hil.restoring.restore import restore
from tests.scenario.cut_bus import CutBus
from tests.scenario.measuring import Rig, StopAfter, measuring_rig
from tests.scenario.processes import VELOCITY_UNIT_RAD_S

COMMANDS = {"direction": "host_to_drive", "frames": ["pdo"]}
READINGS = {"direction": "drive_to_host", "frames": ["pdo"]}
FRAME_US = 90.0
"""A command on an idle bus of 1 Mbit/s takes no longer."""


def bad_way(side: str) -> dict[str, Any]:
    """Commands: 10 % lost, the others 600 us late."""
    return {
        "loss": [{"side": side, **COMMANDS, "probability": 0.1}],
        "delay": [{"side": side, **COMMANDS, "delay_us": 600}],
    }


class Frames:
    """Those that passed the host's link."""

    def __init__(self) -> None:
        self._seen: list[tuple[int, bytes]] = []

    def __call__(
        self, _direction: str, can_id: int, data: bytes, _extended: bool, _remote: bool, _at: Instant
    ) -> None:
        self._seen.append((can_id, data))

    def of(self, can_id: int) -> list[bytes]:
        return [data for seen, data in self._seen if seen == can_id]


def stage(measured: Measured, key: str) -> Stage:
    drive = measured.drives[0]
    return next(each for each in (*measured.host, *drive.stages) if each.key == key)


def us(each: Stage, share: float) -> float:
    value = each.times.quantile_ns(share)
    assert value is not None, each.basis
    return value / 1e3


def within(losses: Losses, rate: float) -> bool:
    assert losses.interval is not None
    return losses.interval.low <= rate <= losses.interval.high


def test_commands_lost_and_late_behind_the_bus(tmp_path: Path) -> None:
    with measuring_rig(tmp_path, bad_way("drive")) as rig:
        measured = rig.measure(cycles=5000, enable=True)
    losses = measured.drives[0].losses
    behind = losses["command_behind_bus"]
    assert behind.lost / behind.known == pytest.approx(0.1, abs=0.01)
    assert within(behind, 0.1)
    assert behind.model is not None
    assert behind.model.independent
    assert losses["command_before_bus"].lost == 0
    acting = stage(measured, "command_acting")
    assert acting.times.total > 4000
    for share in (0.01, 0.5, 0.99, 1.0):
        assert us(acting, share) == pytest.approx(600.0, abs=10.0)
    assert us(stage(measured, "command_on_bus"), 0.5) < FRAME_US
    network = measured.network
    assert network is not None
    assert network.commands == "measured"
    assert network.command_loss_percent == pytest.approx(10.0, abs=1.0)
    assert network.certainty is not None
    assert network.certainty.command_loss_percent is not None


def test_commands_lost_and_late_in_front_of_the_bus(tmp_path: Path) -> None:
    """The echo tells, whether or not the drive is enabled."""
    with measuring_rig(tmp_path, bad_way("host")) as rig:
        measured = rig.measure(cycles=5000)
    losses = measured.drives[0].losses
    before = losses["command_before_bus"]
    assert before.lost / before.known == pytest.approx(0.1, abs=0.01)
    assert within(losses["command_before_bus"], 0.1)
    on_bus = stage(measured, "command_on_bus")
    assert 600.0 < us(on_bus, 0.01) <= us(on_bus, 0.99) < 600.0 + 100.0


def test_bursts_of_lost_readings_and_their_delay(tmp_path: Path) -> None:
    """The chain of a fault plan moves with each frame it selects: here with the speed's alone, 181h."""
    burst = {**READINGS, "frames": [0x181], "p_good_to_bad": 0.02, "p_bad_to_good": 0.3, "loss_bad": 0.9}
    late = {**READINGS, "side": "drive", "delay_us": 1500}
    with measuring_rig(tmp_path, {"burst": [burst], "delay": [late]}) as rig:
        measured = rig.measure(cycles=10_000)
    losses = measured.drives[0].losses["reading"]
    assert within(losses, 0.9 * 0.02 / 0.32)
    assert losses.model is not None
    for name, truth in (("p_good_to_bad", 0.02), ("p_bad_to_good", 0.3), ("loss_bad", 0.9)):
        if name in losses.model.intervals:
            low, high = losses.model.intervals[name]
            assert low < truth < high
    assert {"p_good_to_bad", "p_bad_to_good"} <= set(losses.model.intervals)
    reception = stage(measured, "reception")
    assert us(reception, 0.01) == pytest.approx(1500.0 + 118.0, abs=10.0)
    assert us(reception, 0.99) == pytest.approx(1500.0 + 118.0, abs=30.0)
    assert measured.drives[0].uncertain < 50, "the delay changed by more than half a period at time zero"


def test_syncs_lost_in_front_of_the_bus_are_not_the_drive_s(tmp_path: Path) -> None:
    lost = {"direction": "host_to_drive", "frames": ["sync"], "probability": 0.05}
    with measuring_rig(tmp_path, {"loss": [lost]}) as rig:
        losses = rig.measure(cycles=3000).drives[0].losses
    assert within(losses["sync_before_bus"], 0.05)
    assert losses["reading"].lost == 0
    assert losses["readings"].lost == losses["sync_before_bus"].lost > 100


@pytest.mark.parametrize("drift_ppm", [100.0, -40.0])
def test_a_drifting_clock_is_known_within_its_stated_error(tmp_path: Path, drift_ppm: float) -> None:
    jitter = {**READINGS, "delay_min_us": 0, "delay_max_us": 300}
    with measuring_rig(tmp_path, {"clock_drift": [{"drift_ppm": drift_ppm}], "delay": [jitter]}) as rig:
        clock = rig.measure(cycles=3000).drives[0].clock
    assert clock is not None
    assert abs(clock.drift_ppm - drift_ppm) < clock.drift_error_ppm < 3.0
    assert clock.error_us < 3.0


def test_a_late_host_is_measured_as_one(tmp_path: Path) -> None:
    stalls = [{"late_us": 300, "every_s": 0.01}, {"late_us": 2200, "at_s": 0.505}]
    with measuring_rig(tmp_path, {"host_stall": stalls}) as rig:
        measured = rig.measure(cycles=1000)
    lateness = stage(measured, "wake_up")
    assert us(lateness, 0.5) == 0.0
    assert us(lateness, 0.95) == pytest.approx(300.0, abs=1.0)
    assert measured.missed == 2


def test_a_disabled_drive_stays_so_and_says_what_was_not_measured(tmp_path: Path) -> None:
    states: set[State] = set()

    def look(phase: str, elapsed_s: float) -> None:  # noqa: ARG001
        states.add(rig.servos[0].drive.power.state)

    frames = Frames()
    with measuring_rig(tmp_path) as rig:
        rig.world.link.tap(frames)
        measured = rig.measure(progress=look)
    assert states == {State.SWITCH_ON_DISABLED}
    *commands, last = frames.of(0x201)
    assert len(commands) == 1000
    assert {data[:2] for data in commands} == {bytes(2)}, "disable voltage in every command"
    assert last[:2] == b"\x02\x00", "and quick stop at the end"
    acting = stage(measured, "command_acting")
    assert not acting.measured
    assert acting.basis == NOT_ENABLED
    assert measured.drives[0].losses["command_behind_bus"].known == 0
    assert measured.network is not None
    assert measured.network.commands == "not measured"
    assert measured.echoes is EchoBasis.BUS


def test_without_events_the_effect_of_a_command_is_bracketed_by_syncs(tmp_path: Path) -> None:
    with measuring_rig(tmp_path, bad_way("drive"), lacks=("tpdo events",)) as rig:
        measured = rig.measure(cycles=2000, enable=True)
    drive = measured.drives[0]
    assert [each.key for each in drive.stages].count("command_acting_least") == 0
    assert any("6074h" in note for note in drive.notes)
    assert stage(measured, "command_acting").basis == NO_DEMAND


def test_with_6074h_at_syncs_only_the_delay_lies_within_the_bracket(tmp_path: Path) -> None:
    """Two drives: the bus has no room for a frame more in each cycle."""
    with measuring_rig(tmp_path, bad_way("drive"), nodes=(1, 2)) as rig:
        measured = rig.measure(cycles=2000, enable=True)
    least, most = stage(measured, "command_acting_least"), stage(measured, "command_acting")
    assert us(least, 0.9) <= 600.0 <= us(most, 0.1)
    assert any("no room on the bus" in note for note in measured.drives[0].notes)


@pytest.mark.parametrize(
    ("lack", "key", "basis"), [("6074", "command_acting", NO_DEMAND), ("1013", "sample", NO_CLOCK)]
)
def test_a_drive_that_does_not_tell_is_not_measured_there(
    tmp_path: Path, lack: str, key: str, basis: str
) -> None:
    with measuring_rig(tmp_path, lacks=(lack,)) as rig:
        measured = rig.measure(enable=True)
    assert stage(measured, key).basis == basis
    assert not stage(measured, key).measured
    assert stage(measured, "reception").measured
    assert (measured.drives[0].clock is None) == (lack == "1013")


# ---- every way out ----------------------------------------------------------------------------------------


def assert_as_before(rig: Rig, before: dict[tuple[int, int, int], bytes], said: Sequence[str] = ()) -> None:
    assert rig.memory() == before
    assert {servo.drive.power.state for servo in rig.servos} <= {State.SWITCH_ON_DISABLED, State.FAULT}
    assert not rig.folder.exists(), "nothing is left to put back"
    assert rig.said == list(said), "and all are at rest"


@pytest.mark.parametrize("enable", [False, True])
def test_the_dictionaries_are_as_before(tmp_path: Path, enable: bool) -> None:
    with measuring_rig(tmp_path, nodes=(1, 2)) as rig:
        before = rig.memory()
        rig.measure(cycles=200, enable=enable, period_us=2000)
        assert_as_before(rig, before)


@pytest.mark.parametrize("seconds", [0.0, 0.05, 0.3, 0.6, 1.5])
def test_ctrl_c_puts_everything_back(tmp_path: Path, seconds: float) -> None:
    with measuring_rig(tmp_path) as rig:
        before = rig.memory()
        try:
            measured = rig.measure(StopAfter(rig.world, seconds), cycles=5000, enable=True)
        except Interrupted:
            assert seconds < 1.5
        else:
            assert measured.interrupted
            assert 0 < measured.cycles < 5000
        assert_as_before(rig, before)


def test_a_fault_of_the_drive_puts_everything_back(tmp_path: Path) -> None:
    broken = {"drive_fault": [{"fault": "over_temperature", "at_s": 0.2}]}
    with measuring_rig(tmp_path, broken) as rig:
        before = rig.memory()
        with pytest.raises(DriveInFault):
            rig.measure(enable=True)
        emergency = "EMCY 4310h (excess temperature of the drive), register 09h (generic, temperature)"
        assert_as_before(rig, before, [f"node 1: {emergency}, manufacturer 0000000000"])


def test_the_journal_of_a_lost_bus_puts_everything_back(tmp_path: Path) -> None:
    """The cable comes out while the drive follows torques: it stops by itself, as the host is gone."""
    with measuring_rig(tmp_path) as rig:
        before = rig.memory()
        cut = CutBus(rig.world.link.bus)
        link = BusLink(cut, rig.world.clock, StampSource.MONOTONIC, "simulated")
        whole, rig.world = rig.world, replace(rig.world, link=link)
        cut.cut_at = 2000
        with pytest.raises(BusDown):
            rig.measure(cycles=5000, enable=True)
        assert rig.servos[0].drive.power.state is State.OPERATION_ENABLED
        journal = rig.folder / "node1.jsonl"
        assert f"hil restore {journal}" in rig.said
        rig.world = whole
        network = CanopenNetwork(whole.link, whole.clock)
        network.pump(network.deadline_after(Duration(2 * NS_PER_S)))
        assert rig.servos[0].drive.power.state is not State.OPERATION_ENABLED
        assert restore(network, read_journal(journal)).complete
        assert rig.memory() == before


def test_a_shaft_that_is_too_fast_is_stopped(tmp_path: Path) -> None:
    """By the host, where the drive has no limit of its own."""
    with measuring_rig(tmp_path, lacks=("6080",)) as rig:
        before = rig.memory()
        with pytest.raises(LimitExceeded, match="beyond the limit"):
            rig.measure(enable=True, torque_max_nm=2.0, speed_max_rad_s=0.5)
        assert_as_before(rig, before)


def test_torque_stays_within_its_bound_and_the_shaft_slow(tmp_path: Path) -> None:
    frames = Frames()
    with measuring_rig(tmp_path) as rig:
        rig.world.link.tap(frames)
        assert not rig.measure(cycles=3000, enable=True, torque_max_nm=0.02).distrust
    torques = [int.from_bytes(data[2:4], "little", signed=True) for data in frames.of(0x201)]
    assert max(map(abs, torques)) == 10, "thousandths of 2 N m"
    assert torques[-1] == 0
    speeds = [int.from_bytes(data[:4], "little", signed=True) for data in frames.of(0x181)]
    assert 0.0 < max(map(abs, speeds)) * VELOCITY_UNIT_RAD_S < 2.5, (
        "a quarter of the limit, from which it brakes"
    )


@pytest.mark.parametrize("torque_nm", [0.001, 2.5, -0.1])
def test_a_torque_that_tells_nothing_or_is_beyond_the_rating_is_refused(
    tmp_path: Path, torque_nm: float
) -> None:
    with measuring_rig(tmp_path) as rig:
        before = rig.memory()
        with pytest.raises(BadInput, match="--torque-max-nm"):
            rig.measure(enable=True, torque_max_nm=torque_nm)
        assert_as_before(rig, before)


def test_a_bus_without_room_is_refused(tmp_path: Path) -> None:
    with (
        measuring_rig(tmp_path, nodes=(1, 2, 3)) as rig,
        pytest.raises(BadInput, match=r"--period-us.* at least \d+"),
    ):
        rig.measure(period_us=500)


# ---- what comes of it -------------------------------------------------------------------------------------


def test_what_was_measured_can_be_replayed(tmp_path: Path) -> None:
    faults = {
        "loss": [{"side": "drive", **COMMANDS, "probability": 0.08}],
        "delay": [
            {"side": "drive", **COMMANDS, "delay_min_us": 300, "delay_max_us": 500},
            {"side": "drive", **READINGS, "delay_min_us": 200, "delay_max_us": 600},
        ],
        "burst": [{**READINGS, "frames": [0x181], "p_good_to_bad": 0.02, "p_bad_to_good": 0.25}],
    }
    with measuring_rig(tmp_path, faults) as rig:
        first = rig.measure(cycles=5000, enable=True)
    with measuring_rig(tmp_path, tomllib.loads(fault_plan_text(first)), seed=2) as rig:
        again = rig.measure(cycles=5000, enable=True)
    for key in ("reception", "command_acting"):
        for share in (0.05, 0.5, 0.95):
            assert us(stage(again, key), share) == pytest.approx(us(stage(first, key), share), abs=40.0), key
    for way in ("reading", "command_behind_bus"):
        rate, replayed = (
            each.lost / each.known for each in (run.drives[0].losses[way] for run in (first, again))
        )
        assert replayed == pytest.approx(rate, abs=0.02)


def test_a_measurement_is_repeated_to_the_last_bit(tmp_path: Path) -> None:
    found = []
    for _ in range(2):
        with measuring_rig(tmp_path, bad_way("drive")) as rig:
            found.append(rig.measure(cycles=500, enable=True).as_json())
    assert found[0] == found[1]


def typed(*options: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, ["measure", "--bus", "simulated", *options])
    return done.exit_code, done.stdout, done.stderr


def test_the_command_leaves_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    out, plan, picture = (tmp_path / name for name in ("network.toml", "faults.toml", "stages.png"))
    options = ["--node", "1", "--cycles", "500", "--enable", "--json", "--out", str(out)]
    status, text, said = typed(*options, "--faults-out", str(plan), "--picture", str(picture))
    assert status == 0, said
    found = json.loads(text)
    assert found["cycles"] == 500
    (drive,) = found["drives"]
    assert drive["stages"]["command_acting"]["max_us"] <= 3.0
    assert found["host"]["sync_on_bus"]["samples"] == 500
    assert drive["losses"]["reading"]["percent_interval"][1] == pytest.approx(0.735, abs=0.01)
    network = load_network(out)
    assert network.commands == "measured"
    assert network.losses_max == 0
    assert network.certainty is not None
    assert network.certainty.reading_delay_share == pytest.approx(1.0 - 3.0 / 500, abs=1e-4)
    assert typed("--node", "1", "--cycles", "100", "--faults", str(plan))[0] == 0
    assert picture.stat().st_size > 0
    assert not (tmp_path / "runs").exists() or not any((tmp_path / "runs").iterdir())


def test_the_report_names_every_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "180")
    status, text, _ = typed("--node", "1", "--cycles", "200")
    assert status == 0
    for title in ("wake-up lateness", "SYNC on the bus", "sample", "reception to user code", "computation"):
        assert title in text
    assert "not measured: the drive is disabled" in text
    assert "drift" in text
