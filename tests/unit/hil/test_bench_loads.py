"""All load machines of a bench, from the first to the last, and the options of simulated ones."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from struct import pack
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BadInput, NoAnswer, PeerFault
from servobench.drivers.instruments.dynamometer import LoadReading
from servobench.drivers.timebase import Duration
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.load import load_machines
from servobench.hil.load.load_machines import (
    InstrumentLoadMachine,
    LoadMachines,
    ObjectLoadMachine,
)
from servobench.hil.load.simulated_load import SimulatedLoadMachine, load_table, load_tables
from servobench.hil.recording.run_recorder import RunRecorder
from servobench.virtual_bus.instruments.serial_line import LineFaults
from tests.motors import LING
from tests.unit.hil.test_shaft_loads import MS, STEP, ZERO, Dictionary, Instrument, network, signal_file
from tests.unit.hil.test_signal_file import written

# ---- all of a bench -----------------------------------------------------------------------------------


class Recorder:
    """Takes what a load machine measured."""

    def __init__(self) -> None:
        self.loads: list[tuple[object, ...]] = []

    def load(self, *what: object) -> None:
        self.loads.append(what)


def bench_of(
    load_machine_axis: str | None = None, loads: Mapping[str, Sequence[Any]] | None = None
) -> BenchConfig:
    settings = SimpleNamespace(reading_every=Duration(20 * MS))
    config = SimpleNamespace(
        axes=("axis1", "axis2"),
        source="bench.toml",
        bench=SimpleNamespace(seed=5),
        load=loads or {},
        load_machine_axis=load_machine_axis,
        load_machine=SimpleNamespace(dialect="a dialect", settings=settings),
    )
    return cast(BenchConfig, config)


def drive_on(node: Dictionary, name: str = "axis1") -> ServoDrive:
    return cast(ServoDrive, SimpleNamespace(name=name, node_id=3, network=node))


class Said:
    """What is said of loads."""

    def __init__(self) -> None:
        self.texts: list[tuple[str, str]] = []

    def __call__(self, text: str, level: str) -> None:
        self.texts.append((text, level))


def test_objects_are_off_at_the_beginning_and_at_the_end(tmp_path: Path) -> None:
    load = signal_file(tmp_path)
    number = load_table(load.signal).number.to_bytes(4, "little")
    plain, shaft, none, said = Dictionary({1: b"\0" * 4}), Dictionary({4: number}), Dictionary(), Said()
    wanted: dict[str, list[Any]] = {"axis1": [STEP], "axis2": [load]}
    loads = LoadMachines(bench_of(loads=wanted), network(plain), cast(RunRecorder, Recorder()), ())
    assert type(loads.find(drive_on(plain), said)) is ObjectLoadMachine
    assert plain.written == [(3, 0x2100, 1, b"\0\0\0\0")]
    assert loads.find(drive_on(shaft, "axis2"), said) is None, "the shaft bears it by itself"
    assert [sub for _, _, sub, _ in shaft.written] == [3, 1]
    assert loads.find(drive_on(none, "axis3"), said) is None
    assert loads.chore is None
    loads.begin_with_next_sync()
    assert [sub for _, _, sub, _ in shaft.written] == [3, 1, 5, 3]
    assert len(plain.written) == 1, "steps are told as they come"
    loads.begin(ZERO)
    plain.fails = True
    loads.take_off(said)
    assert [sub for _, _, sub, _ in shaft.written] == [3, 1, 5, 3, 3, 1], "though the first failed"
    assert said.texts == [(f"the load may still be on: {NoAnswer('nothing came')}", "ERROR")]
    assert loads.figures() is None


@pytest.mark.parametrize("over_time", [True, False])
def test_an_instrument_is_connected_attended_to_and_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, over_time: bool
) -> None:
    instrument, said, recorder = Instrument(), Said(), Recorder()
    made: list[tuple[object, ...]] = []

    def line(*arguments: object) -> Any:
        made.append(arguments)
        return SimpleNamespace(name="a port")

    def dynamometer(*arguments: object) -> Instrument:
        made.append(arguments)
        return instrument

    monkeypatch.setattr(load_machines, "instrument_line", line)
    monkeypatch.setattr(load_machines, "Dynamometer", dynamometer)
    config = bench_of("axis2", {"axis2": [signal_file(tmp_path) if over_time else STEP]})
    servos: Any = ["the first", "the second"]
    clock = SimpleNamespace(now=lambda: ZERO)
    bus = SimpleNamespace(clock=clock, pump=lambda until: None)
    loads = LoadMachines(config, cast(CanopenNetwork, bus), cast(RunRecorder, recorder), servos)
    machine = loads.find(drive_on(Dictionary(), "axis2"), said)
    assert isinstance(machine, InstrumentLoadMachine)
    wanted = cast(Any, config).load_machine
    assert made[0] == (wanted, "bench.toml", clock, "the second", 5)
    assert made[1][1:] == (clock, "a dialect", wanted.settings)
    assert said.texts == [("axis2: load machine on a port is a brake", "INFO")]
    assert loads.chore == machine.attend
    loads.begin(ZERO)
    instrument.readings.append(LoadReading(ZERO, Duration(3), 0.25, -2.0, False))
    machine.attend(ZERO)
    assert recorder.loads == [(ZERO, "axis2", 0.25, -2.0)]
    machine.set_torque(0.5)
    assert instrument.asked == ([] if over_time else [0.5])
    figures = loads.figures()
    assert figures is not None
    assert (figures["axis"], figures["readings"]) == ("axis2", 1)
    instrument.fails = True
    loads.take_off(said)
    assert instrument.calls[-2:] == ["off", "closed"], "the port is given back though it failed"
    assert said.texts[1:] == [(f"the load may still be on: {NoAnswer('nothing came')}", "ERROR")]


# ---- options ------------------------------------------------------------------------------------------


def test_loads_are_asked_for_by_node(tmp_path: Path) -> None:
    path = signal_file(tmp_path).path
    tables = load_tables([f"3={path}", f"12={path}"], [3, 12])
    assert list(tables) == [3, 12]
    assert tables[3].torques_nm == pack("=2d", 0.1, 0.5)
    assert load_tables([], [3]) == {}


@pytest.mark.parametrize("text", ["3", "3=", "=x", "x=x", "4=x", "-3=x", "0003=x", "²=x", ""])
def test_a_load_of_no_node_is_told_in_whole(text: str) -> None:
    with pytest.raises(BadInput) as caught:
        load_tables([text], [3, 12])
    error = caught.value
    assert (error.source, error.key, error.value) == ("--load", "", text)
    assert error.expected == "NODE=FILE with one of the nodes 3, 12, each once"


def test_a_node_has_one_load_and_a_load_is_a_torque(tmp_path: Path) -> None:
    path = signal_file(tmp_path).path
    with pytest.raises(BadInput, match="each once"):
        load_tables([f"3={path}", f"3={path}"], [3])
    speeds = written(tmp_path / "speed.csv", {"time_s": [0.0], "speed_rpm": [1.0]})
    with pytest.raises(BadInput) as caught:
        load_tables([f"3={speeds}"], [3])
    assert (caught.value.value, caught.value.expected) == (f"3={speeds}", "a file with torque_nm")


def test_a_simulated_instrument_is_wanted_by_its_path() -> None:
    motor: PmsmParameters = LING
    assert SimulatedLoadMachine.wanted(None, [], motor) is None
    made = SimulatedLoadMachine.wanted(Path("brake"), [], motor)
    assert made == SimulatedLoadMachine(Path("brake"), LineFaults(), motor.torque_max_nm)
    with pytest.raises(BadInput) as caught:
        SimulatedLoadMachine.wanted(None, ["late=1", "x"], motor)
    error = caught.value
    assert (error.source, error.value) == ("--load-machine-fault", "late=1")
    assert error.expected == "--load-machine PATH beside it"


def test_peer_faults_alone_are_borne() -> None:
    """A defect of this program is none."""

    def act() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        LoadMachines._try(act, Said())
    said = Said()

    def fail() -> None:
        raise PeerFault("it stands")

    LoadMachines._try(fail, said)
    assert said.texts == [(f"the load may still be on: {PeerFault('it stands')}", "ERROR")]
