"""What simulated drives are given by a bench and by ``hil simulate``, which hosts them until a stop."""

import signal
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from struct import unpack
from typing import Any, Final

import can
import numpy as np
import pytest

from servobench.drivers.canopen.nmt_states import UNCONFIGURED
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Clock, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.link import BusLink
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.execution import simulated_drives as hosting
from servobench.hil.execution.device_files import DeviceFiles
from servobench.hil.execution.simulated_drives import (
    drive_parameters,
    host_drives,
    simulate,
    simulated_drives,
)
from servobench.hil.execution.world import WorldPlan
from servobench.virtual_bus.drive.load_object import LoadTable
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from servobench.virtual_bus.frame import Device, Frame
from tests.rehearsals.made_sheet import PRODUCT, REVISION, VENDOR, MadeSheet
from tests.unit.hil.test_config import EXAMPLES, edited
from tests.unit.hil.test_signal_file import written

CONTROLLERS: Final = Path(EXAMPLES) / "controllers"
SAMPLED: Final = """[current_controller]
kind = "sampled"
axis = "{axis}"
gain = 2.0
zeros_z = []
poles_z = [[0.5, 0.0]]
sample_rate_hz = {rate}
"""
OTHER_MOTOR: Final = toml_text(
    LING2012.model_dump(mode="json", exclude_none=True)
    | {"mechanics": {"inertia_kg_m2": 0.002, "viscous_friction_nm_s": 0.00185}}
)
_channels: Final = count()


def bench_with(**tables: Any) -> BenchConfig:
    """The example, whose drive has these tables."""
    raw = edited("drive", "axis1", "node", value=3)
    raw["drive"]["axis1"].update(tables)
    return bench_from(raw, "bench.toml", Path(EXAMPLES))


def sampled(folder: Path, axis: str = "q", rate: int = 16_000) -> Path:
    path = folder / f"{axis}-{rate}.toml"
    path.write_text(SAMPLED.format(axis=axis, rate=rate))
    return path


# ---- of a bench -----------------------------------------------------------------------------------------


def test_a_drive_is_what_its_tables_say(tmp_path: Path) -> None:
    config = bench_with(
        simulation={"inner_rate_hz": 20_000, "clock_drift_ppm": 12.5, "encoder_counts_per_revolution": 4096},
        current_control={"controller": str(sampled(tmp_path, rate=20_000))},
    )
    (drive,) = simulated_drives(config)
    parameters = drive.drive.drive
    assert (drive.node_id, drive.drive.motor) == (3, config.drive["axis1"].motor.parameters)
    assert (parameters.inner_rate_hz, parameters.clock_drift_ppm) == (20_000, 12.5)
    assert parameters.encoder_counts_per_revolution == 4096
    assert (parameters.controller_d, parameters.load) == (None, None)
    controller = parameters.controller_q
    assert controller is not None
    assert (controller.order, controller.period_s) == (1, 1 / 20_000)


def test_a_drive_stamps_as_its_tables_say() -> None:
    keys: dict[str, Any] = {
        "stamp_unit_us": 10.0,
        "stamp_resolution_us": 250.0,
        "stamp_bits": 24,
        "stamp_latched": "arrival",
        "stamp_late_us": 12.5,
        "stamp_runs": False,
        "sync_jitter_us": 400.0,
        "sync_phase_us": 100.0,
        "gain_objects": True,
    }
    (drive,) = simulated_drives(bench_with(simulation=keys))
    parameters = drive.drive.drive
    assert {key: getattr(parameters, key) for key in keys} == keys


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("stamp_resolution_us", 0.5, "at least stamp_unit_us = 1"),
        ("stamp_resolution_us", 2000.0, "a value <= 1000.0"),
        ("stamp_bits", 8, "a value >= 16"),
        ("stamp_latched", "later", "one of 'sampling', 'arrival' or 'tick'"),
        ("stamp_late_us", 101.0, "a value <= 100.0"),
        ("sync_jitter_us", -1.0, "a value >= 0.0"),
    ],
)
def test_a_stamp_that_cannot_be_is_refused(key: str, value: float | str, expected: str) -> None:
    with pytest.raises(BadInput) as caught:
        bench_with(simulation={key: value})
    assert (caught.value.key, caught.value.expected) == (f"drive.axis1.simulation.{key}", expected)


def test_a_drive_is_simulated_by_a_data_sheet_on_a_motor_of_its_own(tmp_path: Path) -> None:
    sheet, motor = tmp_path / "made.eds", tmp_path / "shaft.toml"
    sheet.write_text(MadeSheet().text())
    motor.write_text(OTHER_MOTOR)
    tables = {"eds": str(sheet), "motor": str(motor), "clock_drift_ppm": 3.0}
    (drive,) = simulated_drives(bench_with(simulation=tables))
    assert [drive.dictionary.variable(0x1018, sub).value for sub in (1, 2, 3)] == [VENDOR, PRODUCT, REVISION]
    assert drive.drive.motor == replace(LING2012.parameters, inertia_kg_m2=0.002)
    assert drive.drive.drive.clock_drift_ppm == 3.0


def test_a_drive_is_simulated_by_the_seed_of_a_rehearsal() -> None:
    (drive,) = simulated_drives(bench_with(simulation={"rehearse": 7, "inner_rate_hz": 20_000}))
    truth = unknown_drive(7, 3)[1]
    assert (drive.node_id, drive.drive.motor, drive.drive.drive.inner_rate_hz) == (3, truth.motor, 20_000)
    assert drive.drive.drive.encoder_counts_per_revolution == truth.counts_per_revolution


@pytest.mark.parametrize("key", ["eds", "motor"])
def test_a_seed_leaves_nothing_to_a_file(key: str, tmp_path: Path) -> None:
    file = tmp_path / "shaft.toml"
    file.write_text(OTHER_MOTOR)
    with pytest.raises(BadInput) as caught:
        bench_with(simulation={"rehearse": 7, key: str(file)})
    assert (caught.value.key, caught.value.expected) == (
        "drive.axis1.simulation.rehearse",
        f"no drive.axis1.simulation.{key} beside it",
    )


def test_a_controller_for_another_rate_is_refused(tmp_path: Path) -> None:
    config = bench_with(current_control={"controller_d": str(sampled(tmp_path, "d", 8_000))})
    with pytest.raises(BadInput) as caught:
        simulated_drives(config)
    assert str(caught.value) == (
        'current_control: d: found "made for 8000 Hz, the drive\'s inner rate is 16000 Hz",'
        " expected a controller for an inner rate of 16000 Hz"
    )


def test_a_lack_that_cannot_be_is_told_whole() -> None:
    with pytest.raises(BadInput) as caught:
        simulated_drives(bench_with(simulation={"lacks": ["5FFF"]}))
    error = caught.value
    assert (error.source, error.key, error.value) == ("bench.toml", "drive.axis1.simulation.lacks", "5FFF")
    assert (error.expected, error.remedy) == (
        "objects that the simulated drive has and could do without",
        "see hil docs simulated-drive",
    )


def doubles(octets: bytes) -> list[float]:
    return list(unpack(f"={len(octets) // 8}d", octets))


def load_of(config: BenchConfig) -> tuple[list[float], list[float]] | None:
    (drive,) = simulated_drives(config)
    table = drive.drive.drive.load
    return None if table is None else (doubles(table.times_s), doubles(table.torques_nm))


def test_a_shaft_bears_the_load_of_its_file_unless_an_instrument_makes_it(tmp_path: Path) -> None:
    path = written(tmp_path / "load.csv", {"time_s": [0.0, 0.5, 1.0], "torque_nm": [0.1, 0.4, 0.2]})
    raw = edited("load", value={"axis1": [{"kind": "file", "path": str(path)}]})
    config = bench_from(raw, "bench.toml", Path(EXAMPLES))
    assert load_of(config) == ([0.0, 0.5, 1.0], [0.1, 0.4, 0.2])
    machine = {"kind": "magtrol_dsp7000", "port": "simulated", "torque_max_nm": 1.0}
    instrument = bench_from({**raw, "load_machine": machine}, "bench.toml", Path(EXAMPLES))
    assert load_of(instrument) is None
    steps = edited("load", value={"axis1": [{"at_s": 0.1, "torque_nm": 0.2}]})
    assert load_of(bench_from(steps, "bench.toml", Path(EXAMPLES))) is None
    assert load_of(bench_from(edited("load", value={}), "bench.toml", Path(EXAMPLES))) is None


def test_the_drives_of_a_bench_are_in_the_order_of_its_axes_each_with_its_own_clock() -> None:
    config = bench_from(edited("bench", "seed", value=7), "bench.toml", Path(EXAMPLES))
    second = config.drive["axis1"].model_copy(update={"node": 9})
    both = config.model_copy(update={"drive": {"b": config.drive["axis1"], "a": second}})
    assert [drive.node_id for drive in simulated_drives(both)] == [9, config.drive["axis1"].node]
    by_hand = [SimulatedServo(9, second.motor.parameters, seed=seed) for seed in (7, 8)]
    (made, _) = simulated_drives(both)
    clocks = [each.clock.local_ns(Instant(0)) for each in (made, *by_hand)]
    assert clocks[0] == clocks[1] != clocks[2]


# ---- of hil simulate ------------------------------------------------------------------------------------


def test_current_controllers_are_sampled_for_the_axis_that_they_name(tmp_path: Path) -> None:
    assert drive_parameters([]) == DriveParameters()
    made = drive_parameters([sampled(tmp_path, "d"), CONTROLLERS / "azaiz2007-kq.toml"])
    assert made.controller_d is not None
    assert made.controller_q is not None
    assert (made.controller_d.order, made.controller_q.order) == (1, 3)
    assert np.array_equal(made.controller_d.A, [[0.5]])
    assert made.controller_d.period_s == made.controller_q.period_s == 1 / 16_000


def test_two_controllers_of_one_axis_are_refused(tmp_path: Path) -> None:
    first = sampled(tmp_path, "q")
    with pytest.raises(BadInput) as caught:
        drive_parameters([first, sampled(tmp_path, "d"), first])
    assert str(caught.value) == (
        f"--current-control: found '{first}', expected one controller for the q axis at most"
    )


class Other:
    """A device of which it is noted that it was powered on."""

    wake_at: Instant | None = None

    def __init__(self) -> None:
        self.started = 0

    def start(self, now: Instant) -> Sequence[Frame]:
        self.started += 1
        del now
        return (Frame(0x7FF, b"other"),)

    def wake(self, now: Instant) -> Sequence[Frame]:
        del now
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        del frame, now
        return ()


class Hosted:
    """What is said while drives are hosted; with ``title`` comes a signal to stop."""

    def __init__(self, title: str) -> None:
        self.said: list[str] = []
        self._title = title

    def say(self, text: str) -> None:
        if text == self._title:
            signal.raise_signal(signal.SIGTERM)
        self.said.append(text)


@pytest.fixture(autouse=True)
def ordinary_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel is asked for nothing, and so grants nothing."""
    monkeypatch.setattr(hosting, "realtime_process", lambda: nullcontext(("locked memory",)))


def heard(bus: can.BusABC) -> list[tuple[int, bytes]]:
    frames = []
    while (message := bus.recv(0.0)) is not None:
        frames.append((message.arbitration_id, bytes(message.data)))
    return frames


def test_drives_are_hosted_until_a_stop_signal() -> None:
    spec = parse_bus_spec(f"virtual:hosted-{next(_channels)}")
    plan = WorldPlan(spec, 1_000_000, side="drive")
    hosted, other = Hosted("here they are"), Other()
    before = signal.getsignal(signal.SIGTERM)
    with can.Bus(interface="virtual", channel=spec.channel) as bus:
        drives = [SimulatedServo(node, LING2012.parameters) for node in (4, 5)]
        others: list[Device] = [other]
        host_drives(plan, drives, [], "here they are", hosted.say, others=others)
        frames = heard(bus)
    assert signal.getsignal(signal.SIGTERM) is before
    assert hosted.said == ["not granted by the kernel: locked memory", "here they are"]
    assert other.started == 1
    assert frames == [(0x704, b"\0"), (0x705, b"\0"), (0x7FF, b"other")], "boot-ups, and the other's frame"


@pytest.mark.parametrize("forced", [None, False, True])
def test_before_all_it_is_asked_who_has_the_ids(monkeypatch: pytest.MonkeyPatch, forced: bool | None) -> None:
    asked: list[tuple[str, Sequence[int], bool]] = []

    def refuse(link: BusLink, _clock: Clock, ids: Sequence[int], say: object, force: bool) -> None:
        asked.append((link.name, ids, force))
        assert say == hosted.say
        raise ZeroDivisionError

    monkeypatch.setattr(hosting, "refuse_taken", refuse)
    spec = parse_bus_spec(f"virtual:hosted-{next(_channels)}")
    hosted = Hosted("unsaid")
    host = host_drives if forced is None else partial(host_drives, force=forced)
    with pytest.raises(ZeroDivisionError):
        host(WorldPlan(spec, 1_000_000), [], [4, 5], "unsaid", hosted.say)
    assert asked == [(str(spec), [4, 5], bool(forced))]
    assert hosted.said == []


def test_simulate_says_who_is_on_which_bus_and_writes_the_data_sheet(tmp_path: Path) -> None:
    sheet = tmp_path / "drive.eds"
    spec = f"virtual:simulated-{next(_channels)}"
    title = (
        f"simulated drive on {spec}: node 7, unconfigured, motor {LING2012.parameters.name}; Ctrl-C ends it"
    )
    hosted = Hosted(title)
    with can.Bus(interface="virtual", channel=spec.partition(":")[2]) as bus:
        simulate(
            bus_spec=spec,
            nodes=[7, UNCONFIGURED],
            motor=LING2012.parameters,
            faults=None,
            bitrate_bit_s=1_000_000,
            seed=1,
            announce=hosted.say,
            files=DeviceFiles(export=sheet),
            loads={7: LoadTable(b"", b"")},
            force=True,
        )
        frames = heard(bus)
    assert hosted.said == [
        f"its data sheet is {sheet}",
        "not granted by the kernel: locked memory",
        title,
    ]
    assert "[DeviceInfo]" in sheet.read_text(encoding="latin-1").splitlines()
    assert (0x707, b"\0") in frames


def test_simulated_time_has_no_place_for_other_processes() -> None:
    with pytest.raises(BadInput) as caught:
        simulate(
            bus_spec="simulated",
            nodes=[1],
            motor=LING2012.parameters,
            faults=None,
            bitrate_bit_s=1_000_000,
            seed=1,
            announce=print,
            files=DeviceFiles(),
        )
    error = caught.value
    assert (error.source, error.value) == ("--bus", "simulated")
    assert (error.expected, error.remedy) == (
        "a bus that other processes can join",
        "use hub:NAME, or run the bench itself with --bus simulated",
    )
