"""A simulated drive that takes a data sheet, set up by a plan for that sheet, in every mode that it has."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.pdo_plans import TARGETS
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.sheets.capability import capability_of
from servobench.drivers.sheets.dictionary import LoadedDictionary, load_dictionary
from servobench.drivers.sheets.fitness import assess
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.device.vendor_dictionary import BASE_NODE_ID, overlay
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING
from tests.unit.drivers.eds_maker import I8, NODE, U32, Pdo, four_pdos, sheet_text, variable
from tests.unit.drivers.test_vendor_files import FILES

CYCLE = Duration(NS_PER_MS)
UNITS = ScaleOverride(position_rad=1e-4, velocity_rad_s=0.1, rated_torque_nm=2.0)
CYCLES = 5

FIXED = [
    Pdo(0x1400, (0x60400010, 0x60710010), False),
    Pdo(0x1401, (0x60400010, 0x60FF0020), False),
    Pdo(0x1800, (0x60410010, 0x60770010, 0x60610008), False),
    Pdo(0x1801, (0x60640020, 0x606C0020), False),
]

UNMOVED = [replace(pdo, cob_id_access="ro") for pdo in FIXED]
UNTIMED = [replace(pdo, kind_access="ro" if pdo.index < 0x1800 else "rw") for pdo in four_pdos()]


def rehearse(path: Path) -> dict[Mode, int]:
    """Readings in five cycles, by mode."""
    loaded = load_dictionary(path, NODE)
    vendor = partial(overlay, vendor=load_dictionary(path, BASE_NODE_ID).dictionary)
    plan = WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 0)
    with open_world(plan, [SimulatedServo(NODE, LING, vendor=vendor)]) as world:
        network = CanopenNetwork(world.link, world.clock, writes=RIG)
        drive = ServoDrive(network, NODE)
        drive.connect(_soon(network))
        found = {mode: _readings(network, drive, loaded, mode) for mode in _modes(loaded)}
        assert drive.release().at_rest
    return found


def _modes(loaded: LoadedDictionary) -> list[Mode]:
    return [each.mode for each in assess(loaded, NODE, tuple(TARGETS)).usable if each.plan is not None]


def _readings(network: CanopenNetwork, drive: ServoDrive, loaded: LoadedDictionary, mode: Mode) -> int:
    settings = DriveSettings(CYCLE, capability=capability_of(loaded), mode=mode, unwatched=True, scale=UNITS)
    drive.configure(settings)
    drive.enable(_soon(network))
    readings = 0
    for _ in range(CYCLES):
        network.send_sync()
        network.pump(network.deadline_after(CYCLE))
        readings += len(drive.take_readings())
    drive.check()
    drive.disable(_soon(network))
    return readings


def _soon(network: CanopenNetwork) -> Instant:
    return network.deadline_after(Duration(NS_PER_S))


@pytest.mark.parametrize(
    ("pdos", "without", "modes"),
    [
        (four_pdos(), (), 6),
        (four_pdos(entries=1), (), 6),
        (four_pdos(), (0x6077,), 6),
        (four_pdos(), (0x6071,), 4),
        (FIXED, (), 4),
        (UNMOVED, (), 4),
        (UNTIMED, (), 6),
    ],
    ids=[
        "free",
        "one entry a PDO",
        "no torque feedback",
        "no torque set-point",
        "fixed mappings",
        "fixed identifiers",
        "fixed transmission types",
    ],
)
def test_every_kind_of_drive(tmp_path: Path, pdos: list[Pdo], without: tuple[int, ...], modes: int) -> None:
    path = tmp_path / "drive.eds"
    path.write_text(sheet_text(pdos, without=without))
    found = rehearse(path)
    assert len(found) == modes
    assert set(found.values()) == {CYCLES}


@pytest.mark.parametrize(
    ("there", "instead"),
    [
        (variable(0x1005, U32, "rw", "0x80", 0), ""),
        (variable(0x6060, I8, "rww"), variable(0x6060, I8, "wo")),
    ],
    ids=["no object for the SYNC", "write-only mode"],
)
def test_a_peculiar_sheet(tmp_path: Path, there: str, instead: str) -> None:
    path = tmp_path / "drive.eds"
    text = sheet_text(four_pdos())
    assert there in text
    path.write_text(text.replace(there, instead))
    found = rehearse(path)
    assert len(found) == 6
    assert set(found.values()) == {CYCLES}


@pytest.mark.skipif(not FILES, reason="no vendors' data sheets on this machine")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem[:24])
def test_vendors_drives(path: Path) -> None:
    assert set(rehearse(path).values()) <= {CYCLES}
