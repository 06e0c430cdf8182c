"""A drive is written what the command's list names, by the word of a third device on its bus."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from runpy import run_path
from types import MappingProxyType
from typing import Any, Final
from unittest.mock import patch

import numpy as np
import pytest

from servobench.drivers.canopen.bus_scan import BusScan
from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.canopen.write_list import NOTHING, WriteList
from servobench.drivers.cia402.motion import MoveProfile
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.execution.bench import run_bench
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.inspecting.drive_fault import look_at_fault
from servobench.hil.inspecting.stopping import stop_drives
from servobench.hil.restoring.journal import DriveMark, JournalContents, JournalHead, ObjectKey, ObjectWrite
from servobench.hil.restoring.restore import restore
from servobench.hil.testing.drive_rig import drive_rig
from servobench.hil.testing.hosted import DriveHost, DriveWish
from servobench.hil.testing.one_run import run
from servobench.hil.write_lists import FAULT, RESTORE, STOP, writes_of
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.drive.load_object import LOAD_MACHINE, SIMULATED_DRIVE
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.draws import few_pairs
from tests.motors import LING
from tests.rehearsals.made_sheet import MadeSheet
from tests.rehearsals.rehearsal import rehearsed
from tests.scenario.foreign_node import beside_the_bench, put_on_the_bus
from tests.scenario.measuring import measuring_rig
from tests.sdo_writes import OF_MAKERS, SdoWrites

ROOT: Final = Path(__file__).parents[2]
EXAMPLES: Final = ROOT / "examples"
BENCHES: Final = {"cst": "ling2012.toml", "csv": "position_csv.toml", "csp": "position_csp.toml"}
SHORT: Final = {"bench.duration_s": 0.3, "reference": None, "verdict": None, "load": None}
LOAD: Final = (LOAD_MACHINE, 1)
EDS: Final = "drive.axis1.simulation.eds"
EMPTY: Final[Mapping[str, Any]] = MappingProxyType({})


def ran(
    bench: str,
    changes: Mapping[str, Any] = EMPTY,
    seen: Callable[[SimulatedServo], None] = lambda _drive: None,
) -> tuple[SdoWrites, SimulatedServo]:
    """An example without reference and load for 0.3 s; its drive, of which ``seen`` was told at first."""
    heard, drives = SdoWrites(), list[SimulatedServo]()

    def keep(drive: SimulatedServo) -> None:
        drives.append(drive)
        seen(drive)

    with beside_the_bench(heard, seen=keep):
        tables = Bench.load(EXAMPLES / BENCHES[bench]).changed({**SHORT, **changes})
        run_bench(tables.config, keep=False)
    return heard, drives[0]


def foreign_sheet(folder: Path, **options: Any) -> Path:
    """Of a drive of another make, which has an UNSIGNED16 of its own at 2100h:01."""
    sheet = MadeSheet()
    sheet.drop(LOAD_MACHINE)
    sheet.add(LOAD_MACHINE, {1: DataType.UNSIGNED16})
    sheet.set(LOAD_MACHINE, 1, default=7, **options)
    path = folder / "foreign.eds"
    path.write_text(sheet.text())
    return path


# ---- runs -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", BENCHES)
def test_a_run_without_load_writes_no_object_of_a_maker(mode: str) -> None:
    heard, _ = ran(mode)
    assert heard.unlisted(writes_of("run")) == []


def test_a_load_that_an_earlier_run_has_left_is_taken_off() -> None:
    def leave(drive: SimulatedServo) -> None:
        drive.dictionary.download(*LOAD, (200).to_bytes(4, "little"))

    heard, drive = ran("cst", seen=leave)
    assert {key for key in heard.objects if key[0] in OF_MAKERS} == {LOAD, (LOAD_MACHINE, 3)}
    assert drive.dictionary.upload(*LOAD) == bytes(4)


def test_a_run_with_a_load_writes_its_torque_and_takes_it_off() -> None:
    heard, drive = ran("cst", {"load": {"axis1": [{"at_s": 0.1, "torque_nm": 0.2}]}})
    assert {key for key in heard.objects if key[0] in OF_MAKERS} == {LOAD}
    assert [write.product for write in writes_of("run") if write.covers(*LOAD)] == [SIMULATED_DRIVE]
    assert drive.dictionary.upload(*LOAD) == bytes(4)


@pytest.mark.parametrize(("mode", "access"), few_pairs(BENCHES, ["rw", "ro"], 1))
def test_another_makes_2100h_is_neither_written_nor_read(mode: str, access: str, tmp_path: Path) -> None:
    """rw: as in maxon's EPOS2, where it is a brake's reaction time; ro: as the EPOS4's serial number."""
    sheet = foreign_sheet(tmp_path, AccessType=access)
    heard, drive = ran(mode, {EDS: str(sheet)})
    assert heard.unlisted(writes_of("run")) == []
    assert [key for key in heard.asked if key[0] in OF_MAKERS] == []
    assert drive.dictionary.upload(*LOAD) == b"\7\0"


def test_a_load_for_a_drive_of_another_make_is_refused_with_the_reason(tmp_path: Path) -> None:
    load = {"axis1": [{"at_s": 0.1, "torque_nm": 1.0}]}
    with pytest.raises(BadInput) as caught:
        ran("cst", {"load": load, EDS: str(foreign_sheet(tmp_path))})
    assert caught.value.key == "load.axis1"
    assert "product 00000B22h" in caught.value.value
    assert "the only drive with a load machine" in caught.value.expected


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("cst", [0x60400010, 0x60710010, 0x60810020]),
        ("cst", [0x60400010, 0x23000110, 0x60710010]),
        ("csv", [0x60400010, 0x60FF0020, 0x23000110]),
        ("csp", [0x60400010, 0x607A0020, 0x23000110]),
    ],
)
def test_a_fixed_rpdo_leaves_the_further_objects_that_it_carries_as_they_are(
    mode: str, words: list[int], tmp_path: Path
) -> None:
    _, drive = ran(mode, {EDS: str(fixed_sheet(words, tmp_path))})
    assert drive.dictionary.upload(0x2300, 1) == b"\7\0"
    assert drive.dictionary.upload(0x6081, 0) == (1234).to_bytes(4, "little")


def fixed_sheet(words: list[int], folder: Path, access: str = "rw") -> Path:
    """Of a drive whose RPDO1 is mapped for good, and which has an object of its maker at 2300h:01."""
    sheet = MadeSheet()
    sheet.add(0x2300, {1: DataType.UNSIGNED16})
    sheet.set(0x2300, 1, default=7, PDOMapping=1, AccessType=access)
    sheet.set(0x6081, default=1234)
    sheet.map(0x1600, words, "ro")
    path = folder / "fixed.eds"
    path.write_text(sheet.text())
    return path


def test_an_object_that_cannot_be_read_is_carried_by_no_rpdo(tmp_path: Path) -> None:
    sheet = fixed_sheet([0x60400010, 0x23000110, 0x60710010], tmp_path, "wo")
    with pytest.raises(SettingRefused, match="maps 2300h:01 into an RPDO that the bench has to send"):
        ran("cst", {EDS: str(sheet)})


def test_an_rpdo_carries_what_was_written_last_by_sdo(tmp_path: Path) -> None:
    sheet = fixed_sheet([0x60400010, 0x60870020, 0x60710010], tmp_path)
    host = DriveHost("simulated", tmp_path)
    with drive_rig("simulated", host, DriveWish(eds=sheet)) as rig:
        rig.enable(mode=Mode.PROFILE_TORQUE)
        before = rig.client.objects.read(0x6087)
        rig.client.apply_torque(0.1, rig.deadline(5.0), MoveProfile(torque_slope_nm_s=20.0))
        slope = rig.client.objects.read(0x6087)
        assert slope != before
        rig.client.quick_stop(rig.deadline(5.0))
        assert rig.client.objects.read(0x6087) == slope


def test_a_drive_by_its_own_exported_sheet_runs_as_without_one_load_and_all(tmp_path: Path) -> None:
    sheet = tmp_path / "own.eds"
    sheet.write_text(export_eds(SimulatedServo(1, LING).dictionary))
    loaded = {"bench.duration_s": 0.3, "verdict": None, "load": {"axis1": [{"at_s": 0.1, "torque_nm": 0.5}]}}
    bench = Bench.load(EXAMPLES / BENCHES["cst"]).changed({**loaded, "reference": None})
    plain, by_sheet = run(bench), run(bench.changed({EDS: str(sheet)}))
    assert np.nanmin(plain.column("velocity_rad_s")) < -1.0, "the load turns the shaft"
    assert by_sheet.digest == plain.digest


# ---- other commands ---------------------------------------------------------------------------------------


@contextmanager
def listened(writes: WriteList) -> Iterator[tuple[CanopenNetwork, SdoWrites, SimulatedServo]]:
    """A master with a list, and a drive with the device beside it."""
    servo, heard = SimulatedServo(1, LING), SdoWrites()
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000), [servo]) as world:
        put_on_the_bus(world, heard)
        yield CanopenNetwork(world.link, world.clock, writes=writes), heard, servo


def test_a_stop_writes_the_controlword_alone() -> None:
    with listened(STOP) as (network, heard, _):
        assert stop_drives(network, [1])[0].at_rest
        assert heard.objects <= {(0x6040, 0)}


def test_a_reset_writes_the_controlword_alone() -> None:
    with listened(FAULT) as (network, heard, servo):
        network.pump(network.deadline_after(Duration(100 * NS_PER_MS)))
        servo.drive.fail(0x4210, ErrorRegister.TEMPERATURE)
        assert look_at_fault(network, 1, reset=True).was_reset
        assert heard.objects == {(0x6040, 0)}


def test_a_scan_writes_nothing() -> None:
    with listened(NOTHING) as (network, heard, _):
        scan = BusScan(network)
        scan.probe()
        assert [node.node_id for node in scan.found()] == [1]
        assert heard.objects == set()
        assert heard.asked


def test_restoring_writes_what_the_journal_names() -> None:
    limit, heartbeat = ObjectKey(0x6072, 0), ObjectKey(0x1017, 0)
    changes = [ObjectWrite(limit, b"\1\0", b"\2\0"), ObjectWrite(heartbeat, b"\x50\0", b"\0\0")]
    contents = JournalContents(JournalHead("x", 1, DriveMark(0, 0, 0), 127), changes)
    with listened(RESTORE) as (network, heard, servo):
        assert restore(network, contents).complete
        assert heard.objects - {(0x6040, 0)} == {(0x6072, 0), (0x1017, 0)}
        assert servo.dictionary.upload(0x6072, 0) == b"\1\0"


def test_a_measurement_writes_its_list_and_puts_it_back(tmp_path: Path) -> None:
    heard = SdoWrites()
    with measuring_rig(tmp_path) as rig:
        put_on_the_bus(rig.world, heard)
        rig.measure(enable=True, cycles=50)
    assert heard.unlisted(writes_of("measure")) == []


def test_commissioning_a_drive_of_another_make_writes_its_list(tmp_path: Path) -> None:
    heard = SdoWrites()

    @contextmanager
    def heard_world(*given: Any) -> Iterator[Any]:
        with open_world(*given) as world:
            put_on_the_bus(world, heard)
            yield world

    with patch("servobench.hil.commissioning.commission.open_world", heard_world):
        result = rehearsed(foreign_sheet(tmp_path), tmp_path, last_step="enable")
    assert result.reason == ""
    assert result.restored
    assert heard.unlisted(writes_of("commission")) == []


# ---- the page ---------------------------------------------------------------------------------------------


def test_the_page_shows_the_lists() -> None:
    made = run_path(str(ROOT / "docs" / "make_writes.py"))
    assert (ROOT / "docs" / "writes.md").read_text(encoding="utf-8") == made["page"](), (
        "python docs/make_writes.py"
    )
