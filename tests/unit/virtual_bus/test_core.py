"""The native core: the same bits from every compiler, and never a core of other sources."""

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from servobench.design.core.build import LIBRARY, ROOMS

ROOT = Path(__file__).parents[3]
CORES = tuple(ROOT / room / "core" for room in ROOMS)
PROGRAM = """
import os, sys
from dataclasses import replace
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_loader
name = "servobench.virtual_bus.core.native"
import servobench.virtual_bus.core
spec = spec_from_loader(name, ExtensionFileLoader(name, os.environ["CORE"]))
sys.modules[name] = module_from_spec(spec)
from servobench.drivers.timebase import Instant
from tests.motors import AZAIZ
from servobench.design.mechanism import Arm, CoggingHarmonic, Coupling, EndStops, Friction, LoadMap
from servobench.design.mechanism import Mechanism, PlacedLoad, Switches
from servobench.virtual_bus.drive.encoder import Encoder, SineErrors, SpeedMethod, SpeedSensing
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.power_stage import CurrentSensors, Inverter
from servobench.virtual_bus.drive.set_point_path import Notch, SetPointPath

rigid = replace(AZAIZ, coulomb_friction_nm=0.1)
real = Mechanism(
    Coupling(5e-4, 6e-4, 300.0, 0.02, 0.002), Friction(0.3, 2.0, 0.15), (CoggingHarmonic(24, 0.2, 1.0),)
)
torques = (0.1, 0.2, 0.3), (0.0, -0.2, 0.4), (0.1, 0.2, 0.3)
table = LoadMap((0.0, 0.5, 2.0), (-40.0, 0.0, 90.0), torques, True)
placed = PlacedLoad(0.2, Arm(0.7, 1.3, 0.4), table, EndStops(-2.0, 3.0, 200.0, 0.1))
ended = replace(real, load=placed, switches=Switches(-1.5, 2.5, (0.3, 0.7), 0.002))
seen = FirmwareParameters(
    encoder=Encoder(512, SineErrors(0.02, -0.01, 0.01, 0.02), 1e-3, 0.5, 2e-5),
    speed=SpeedSensing(SpeedMethod.EDGES, 900.0, 1e8),
    inverter=Inverter(1e-6, 0.1, 0.9),
    path=SetPointPath(torque_filter_hz=900.0, notch=Notch(300.0)),
    current_sensors=CurrentSensors(20.0, 12, 0.01, -0.01, 0.1, 0.05, 0.02),
)
followed = replace(seen, speed=SpeedSensing(SpeedMethod.OBSERVER, None))
flexible, between = replace(rigid, mechanism=real), replace(rigid, mechanism=ended)
drives = (rigid, FirmwareParameters()), (flexible, seen), (flexible, followed), (between, seen)
for motor, parameters in drives:
    firmware = Firmware(motor, parameters)
    now = 0
    for step in range(30):
        firmware.control(InnerControl.TORQUE)
        firmware.demand_torque((-1.0) ** step * 9.0)
        firmware.inner.load_nm = 0.3 * (step % 3)
        if step % 7 == 6:
            firmware.ramp_to_speed(0.0, 4000.0)
        if step % 11 == 10:
            firmware.control(InnerControl.OFF)
        now += 4_000_000
        firmware.advance_to(Instant(now))
        print(firmware.inner.state().hex())
"""
RANDOM_RUN = """
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.design.speed.monte_carlo import Chance, run_many
from tests.motors import LING
run_many(LING, [0.0, -0.02], SampledNetwork(Strategy.ARRIVAL, 0.01, 0, 0.0), Chance(runs=1, seed=0))
"""
COMPILERS = {name: [path] for name in ("gcc", "clang") if (path := shutil.which(name))}
if find_spec("ziglang"):
    COMPILERS["zig"] = [sys.executable, "-m", "ziglang", "cc"]


def built(library: Path, compiler: list[str], *flags: str) -> Path:
    """The core by that compiler, as build.py makes it, with flags added."""
    program = (
        "import sys; from pathlib import Path; from servobench.design.core.build import build; "
        "build('virtual_bus', Path(sys.argv[1]), tuple(sys.argv[2:]))"
    )
    environment = {**os.environ, "CC": " ".join(compiler), "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", program, library, *flags], env=environment, check=True, timeout=100)
    return library


def states(core: Path) -> list[str]:
    """The drive's state after each of some steps, as hex, computed by that core in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "CORE": str(core)},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        timeout=100,
    )
    return done.stdout.split()


@pytest.mark.long
def test_the_same_bits_from_every_compiler_at_every_optimisation(tmp_path: Path) -> None:
    """No fused product, no reordered sum, no library function: so the bits are the same on any machine."""
    used = states(ROOT / "virtual_bus" / "core" / LIBRARY)
    assert len(set(used)) == len(used) == 120
    for name, compiler in COMPILERS.items():
        for level in ("-O0", "-O3"):
            core = built(tmp_path / f"{name}{level}.so", compiler, level)
            assert states(core) == used, f"{name} {level}"


def copy_cores(folder: Path) -> None:
    """Checkout of the rooms with the sources of their cores, which are not built."""
    for core in CORES:
        room = folder / core.parent.name
        shutil.copytree(core, room / "core", ignore=shutil.ignore_patterns("*.so", "__pycache__"))
        for path in core.parent.iterdir():
            if path.name != "core":
                (room / path.name).symlink_to(path)
    (folder / "tests").symlink_to(ROOT / "tests")
    shutil.copytree(ROOT / "servobench", folder / "servobench", symlinks=True)


def said(folder: Path, *command: str) -> str:
    done = subprocess.run(
        [sys.executable, *command],
        cwd=folder,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    return done.stdout.strip() + done.stderr.strip().rpartition("\n")[2]


@pytest.mark.long
def test_a_core_that_is_not_of_its_sources_is_refused(tmp_path: Path) -> None:
    """As after an update of a checkout: no old core runs in silence. A shared header is a source of each."""
    if not COMPILERS:
        pytest.skip("no C compiler")
    copy_cores(tmp_path)
    asks = (
        "-c",
        "from servobench.virtual_bus.core.native import wire_bits; print(wire_bits(0x601 << 4 | 2, b'ab'))",
    )
    draws = ("-c", f"{RANDOM_RUN}print('fresh')")
    assert "make core" in said(tmp_path, *asks)
    assert said(tmp_path, "design/core/build.py") == ""
    first = said(tmp_path, *asks)
    assert first.isdigit()
    assert said(tmp_path, *draws) == "fresh"
    motor, header = tmp_path / "virtual_bus/core/motor.c", tmp_path / "design/core/stable_abi.h"
    kept = motor.read_text()
    motor.write_text(f"{kept}/* edited */\n")
    assert "'built from other sources', expected a fresh one: make core" in said(tmp_path, *asks)
    motor.write_text(kept)
    with header.open("a") as source:
        source.write("/* edited */\n")
    for words in (asks, draws):
        assert "'built from other sources', expected a fresh one: make core" in said(tmp_path, *words)
    assert said(tmp_path, "design/core/build.py") == ""
    assert said(tmp_path, *asks) == first


@pytest.mark.long
def test_sources_that_do_not_compile_leave_the_core_as_it_was(tmp_path: Path) -> None:
    if not COMPILERS:
        pytest.skip("no C compiler")
    copy_cores(tmp_path)
    library = tmp_path / "virtual_bus" / "core" / LIBRARY
    library.write_bytes(b"before")
    library.with_name("motor.c").write_text("no C")
    assert "does not compile" in said(tmp_path, "design/core/build.py")
    assert library.read_bytes() == b"before"
    assert sorted(tmp_path.rglob("*.part")) == []
