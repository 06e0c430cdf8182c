"""What commissioning leaves: the tables of each file, counted by hand."""

import math
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.cia402.profile import Mode, QuickStopOption, run_words
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.dialog import Dialog
from servobench.hil.commissioning.files import (
    _motor_text,
    dcf_text,
    drive_tables,
    set_objects,
    write_files,
)
from servobench.hil.commissioning.identify import Mechanics
from servobench.hil.commissioning.session import Session
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.configuration.network_file import Network, load_network
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.restoring.journal import (
    DriveMark,
    Journal,
    JournaledNetwork,
    JournalHead,
    ObjectKey,
    ObjectWrite,
)
from servobench.hil.write_lists import COMMISSION
from tests.unit.hil.simulated_shaft import LIMITS, RATED_NM, Shaft, request_of, session_of, shaft_of

IDENTITY = Identity("a drive", 7, 8, 1, 9, 0)
MECHANICS = Mechanics(1e-3, 2e-3, 0.05, 0.01, 0.0, 0.0, 0.0, 99, 0.001)
CONTROLLER = {"kind": "pid", "proportional_nm_s_rad": 0.25, "integral_nm_rad": 4.0}
PLATE: dict[str, Any] = {"motor": {"name": "M1"}}
RESTS = "Each figure in N m or kg m^2 rests on the rated torque of 6076h, 1.6 N m, which nothing measured."


def session(plate: dict[str, Any] | None = None, **more: Any) -> Session:
    request = replace(
        request_of(plate or PLATE), bus="hub:a", bitrate_bit_s=500_000, **more.pop("requested", {})
    )
    made = session_of(Shaft(shaft_of(1e-3)), request=request, mechanics=MECHANICS, dictionary=None, **more)
    cast(Any, made).configured = True
    cast(Any, made).unwatched = False
    made.found.identity = IDENTITY
    made.found.mechanics = MECHANICS
    made.found.modes = (Mode.CYCLIC_SYNCHRONOUS_TORQUE,)
    return made


# ---- drive.toml ------------------------------------------------------------------------------------------

THE_DRIVE = {"node": 5, "name": "a drive", "vendor": 7, "product": 8, "revision": 1, "serial": 9}
SUGGESTED = {
    "speed_max_rpm": 3000.0,
    "torque_max_nm": 2.0 * RATED_NM,
    "torque_slew_max_nm_s": 200.0 * RATED_NM,
}


def test_a_drive_as_it_tells_of_itself_needs_few_tables() -> None:
    assert drive_tables(session()) == {"drive": THE_DRIVE, "scale": {}, "limits": SUGGESTED}
    unconfigured = session()
    cast(Any, unconfigured).configured = False
    assert drive_tables(unconfigured) == {"drive": THE_DRIVE, "scale": {}}


def test_all_that_was_found_of_a_drive() -> None:
    made = session()
    found = made.found
    found.override = ScaleOverride(1e-4, None, 0.5, 1.25, velocity_sign=1.0, torque_sign=-1.0)
    found.quick_stop_option = QuickStopOption.CURRENT_LIMIT
    found.current_bandwidth_hz = 800.0
    found.controller = dict(CONTROLLER)
    found.settings = {
        ObjectKey(Object.POLARITY, 0): b"\x80",
        ObjectKey(Object.QUICK_STOP_DECELERATION, 0): b"\x10\x27\0\0",
        ObjectKey(0x1017, 0): b"\x32\0",
    }
    tables = drive_tables(made)
    assert tables == {
        "drive": THE_DRIVE,
        "scale": {"position_rad": 1e-4, "acceleration_rad_s2": 0.5, "rated_torque_nm": 1.25},
        "signs": {"torque": -1, "velocity": 1},
        "stop": {"option": 3},
        "current_loop": {"order": 1, "bandwidth_hz": 800.0},
        "object": [{"index": 0x607E, "sub": 0, "bytes": "80"}],
        "limits": SUGGESTED,
        "controller": CONTROLLER,
    }
    found.quick_stop_rad_s2 = 300.0
    assert drive_tables(made)["object"] == [
        {"index": 0x607E, "sub": 0, "bytes": "80"},
        {"index": 0x6085, "sub": 0, "bytes": "10270000"},
    ]
    found.override = ScaleOverride(velocity_sign=-1.0)
    assert drive_tables(made)["signs"] == {"torque": 1, "velocity": -1}


# ---- motor.toml ------------------------------------------------------------------------------------------


def test_a_motor_of_which_nothing_else_is_known_stands_in() -> None:
    """1 N m per A rms: flux 1/sqrt(2)/(3/2); the inductance has 500 us of 1 ohm; twice the tried speed."""
    text = _motor_text(session())
    flux = 1.0 / math.sqrt(2.0) / 1.5
    assert text.splitlines()[0] == (
        "# Inertia and friction are measured; they include the load on the shaft. "
        f"{RESTS} "
        "Not known: the flux is that of 1 N m per A rms. "
        "Not known: resistance and inductance are stand-ins with the measured lag of the torque. "
        "Not known: the number of pole pairs is not known. "
        "Not known: the DC bus voltage is twice what the rated speed needs."
    )
    assert tomllib.loads(text) == {
        "motor": {
            "name": "M1",
            "resistance_ohm": 1.0,
            "inductance_d_h": 5e-4,
            "inductance_q_h": 5e-4,
            "flux_linkage_wb": pytest.approx(flux),
            "pole_pairs": 1,
            "transform": "amplitude_invariant",
        },
        "mechanics": {
            "inertia_kg_m2": 1e-3,
            "viscous_friction_nm_s": 2e-3,
            "coulomb_friction_nm": 0.05,
        },
        "rating": {
            "torque_nm": RATED_NM,
            "speed_rpm": pytest.approx(3000.0),
            "current_max_a": pytest.approx(math.sqrt(2.0) * 2.0 * RATED_NM),
            "dc_bus_voltage_v": pytest.approx(2.0 * math.sqrt(3.0) * flux * 3000.0 * RAD_S_PER_RPM),
        },
    }


# ---- what is written -------------------------------------------------------------------------------------


Change = tuple[int, int, bytes, bytes]


@pytest.fixture
def network() -> Iterator[JournaledNetwork]:
    """A bus whose drive has not been written to."""
    with open_world(WorldPlan(parse_bus_spec("simulated"), 500_000, False, None, 0), []) as world:
        made = JournaledNetwork(world.link, world.clock, COMMISSION)
        yield made
        for journal in made.journals.values():
            journal.close()


def changed(network: JournaledNetwork, folder: Path, *changes: Change) -> JournaledNetwork:
    """The bus with these changes of its drive in a journal: object, what it held, and what was written."""
    journal = Journal(
        folder / "journal" / "journal.jsonl", JournalHead("hub:a", 5, DriveMark(7, 8, 9), 127, 0)
    )
    for index, sub, old, new in changes:
        journal.note(ObjectWrite(ObjectKey(index, sub), old, new))
        network.taken.setdefault(5, {})[ObjectKey(index, sub)] = new
    network.journals[5] = journal
    return network


def test_what_a_drive_was_set_to_is_without_what_served_a_step(
    network: JournaledNetwork, tmp_path: Path
) -> None:
    made = session(network=network)
    assert set_objects(made) == {}, "there is no journal"
    changed(
        network,
        tmp_path,
        (0x607E, 0, b"\0", b"\x80"),
        (0x1017, 0, b"\0\0", b"\x32\0"),
        (0x1017, 0, b"\x32\0", b"\x64\0"),
        (0x6085, 0, b"\x01", b"\x02"),
        (0x6085, 0, b"\x02", b"\x01"),
        (0x6071, 0, b"\0\0", b"\x05\0"),
        (0x6098, 0, b"\0", b"\x22"),
        (0x6099, 1, b"\0", b"\x22"),
        (0x1400, 1, b"\0", b"\x01"),
        (0x1600, 1, b"\0", b"\x01"),
        (0x1401, 1, b"\0", b"\x01"),
        (0x6072, 0, b"\x01", b"\x09"),
    )
    network.taken[5][ObjectKey(0x6072, 0)] = b"\x01"  # 9 was refused
    made.found.plan = mode_plan(5, PlanWish(Mode.CYCLIC_SYNCHRONOUS_TORQUE))
    expected = {
        ObjectKey(0x607E, 0): b"\x80",
        ObjectKey(0x1017, 0): b"\x64\0",
        ObjectKey(0x1400, 1): b"\x01",
        ObjectKey(0x1600, 1): b"\x01",
    }
    assert set_objects(made) == expected
    made.found.plan = None
    assert set_objects(made) == {
        key: held for key, held in expected.items() if key.index not in (0x1400, 0x1600)
    }


def written(made: Session, folder: Path) -> dict[str, str]:
    write_files(made)
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def test_a_dry_run_leaves_nothing(network: JournaledNetwork, tmp_path: Path) -> None:
    made = session(requested={"out": tmp_path}, network=network)
    made.found.identity = made.found.mechanics = None
    made.found.controller = dict(CONTROLLER)
    assert written(made, tmp_path) == {}


HEARTBEAT: Change = (0x1017, 0, b"\0\0", b"\x32\0")


def test_all_files_are_written_and_read_again(network: JournaledNetwork, tmp_path: Path) -> None:
    made = session(requested={"out": tmp_path}, network=changed(network, tmp_path, HEARTBEAT))
    found = made.found
    found.controller, found.period = dict(CONTROLLER), Duration(2 * NS_PER_MS)
    found.network = Network(period_us=2000, losses_in_a_row_max=1, delay_max_us=1300)
    found.settings = {ObjectKey(0x1017, 0): b"\x32\0"}
    found.dump, found.originals = {(0x1000, 0): b"\x92\1\2\0"}, {ObjectKey(0x1017, 0): b"\0\0"}
    texts = written(made, tmp_path)
    assert sorted(texts) == ["bench.toml", "drive.dcf", "drive.toml", "motor.toml", "network.toml"]
    assert texts["drive.toml"].startswith(f"# The drive as commissioning found it. {RESTS}\n\n")
    assert tomllib.loads(texts["drive.toml"]) == drive_tables(made)
    assert texts["network.toml"].startswith("# What the bus does to readings and commands, measured.\n\n")
    assert load_network(tmp_path / "network.toml") == found.network
    assert texts["motor.toml"] == _motor_text(made)
    assert texts["bench.toml"].startswith(
        f"# A bench for this drive, with the suggested controller and limits. {RESTS}\n\n"
    )
    heartbeats = {"heartbeat_ms": 50, "heartbeat_timeout_ms": 150}
    rpm = float(round(0.4 * LIMITS.speed_rad_s / RAD_S_PER_RPM))
    assert rpm == 600.0
    assert tomllib.loads(texts["bench.toml"]) == {
        "bench": {"name": "commissioned", "duration_s": 3.0},
        "bus": {"spec": "hub:a", "bitrate_bit_s": 500_000},
        "host": heartbeats,
        "loop": {"period_us": 2000},
        "drive": {
            "axis1": {
                "node": 5,
                "motor": "motor.toml",
                "commissioned": "drive.toml",
                **heartbeats,
                "limits": SUGGESTED,
                "controller": CONTROLLER,
            }
        },
        "reference": {
            "axis1": [
                {"kind": "ramp", "at_s": 0.2, "speed_rpm": 600.0, "over_s": 0.4},
                {"kind": "ramp", "at_s": 1.5, "speed_rpm": -600.0, "over_s": 0.8},
            ]
        },
        "verdict": {
            "speed_error_rms_rad_s_max": float(f"{0.25 * 600.0 * RAD_S_PER_RPM:.4g}"),
            "dropouts_percent_max": 10.0,
        },
    }
    held = {ObjectKey(0x1000, 0): b"\x92\1\2\0", ObjectKey(0x1017, 0): b"\0\0"}
    assert texts["drive.dcf"] == dcf_text(found.settings, held, None, 5, 500_000, IDENTITY)


@pytest.mark.parametrize(
    ("modes", "mode"),
    [
        ((Mode.PROFILE_VELOCITY, Mode.INTERPOLATED_POSITION), "ip"),
        ((Mode.PROFILE_TORQUE, Mode.CYCLIC_SYNCHRONOUS_VELOCITY), "csv"),
        ((Mode.PROFILE_VELOCITY, Mode.PROFILE_POSITION), None),
    ],
)
def test_the_bench_is_of_a_mode_that_the_drive_has(
    network: JournaledNetwork, tmp_path: Path, modes: tuple[Mode, ...], mode: str | None
) -> None:
    """Set-points of speed or position where it has no torque mode of cycles."""
    said: list[str] = []
    made = session(
        requested={"out": tmp_path},
        network=changed(network, tmp_path, HEARTBEAT),
        dialog=Dialog(said.append),
    )
    made.found.controller = dict(CONTROLLER)
    made.found.modes = modes
    texts = written(made, tmp_path)
    if mode is None:
        assert "bench.toml" not in texts
        assert said == [f"no bench.toml: {run_words(modes)}"]
        return
    bench = load_bench(tmp_path / "bench.toml")
    drive = bench.drive["axis1"]
    assert (drive.mode, drive.controller.kind, said) == (mode, "stream", [])
