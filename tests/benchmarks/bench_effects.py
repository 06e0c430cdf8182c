"""What an inner tick of the simulated drive costs with each effect of docs/realism.md, and with all of them.

A second at 16 kHz of a shaft that follows a ramp to half of its speed and bears a load: instructions by
callgrind, all in one process, and the processor's time, the least of rounds in which each has its turn. The
first line is the demo's tick, a rigid shaft.
"""

import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

from servobench.design.iron import iron_of
from servobench.design.mechanism import (
    Arm,
    CoggingHarmonic,
    Coupling,
    EndStops,
    Friction,
    LoadMap,
    Mechanism,
    PlacedLoad,
    Side,
    Switches,
)
from servobench.design.motor import PmsmParameters
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.drive.encoder import Encoder, SineErrors, SpeedMethod, SpeedSensing
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.mechanism import FieldOptions
from servobench.virtual_bus.drive.power_stage import (
    Chopper,
    CurrentSensors,
    Inverter,
    Overload,
    Protection,
    Supply,
)
from servobench.virtual_bus.drive.set_point_path import Notch, SetPointPath
from tests.benchmarks.instructions import ROOT, processor_s, switch
from tests.motors import LING

TICKS: Final = 16_000
ROUNDS: Final = 9
EPOCH: Final = Instant(0)

Machine = tuple[PmsmParameters, FirmwareParameters]


def main() -> None:
    """Print a table."""
    if "--counted" in sys.argv:
        for machine in machines().values():
            turn(machine)
        return
    counts, times_ns = counted(), timed()
    print(f"{'an inner tick':24} {'instructions':>12} {'x':>6} {'ns':>6} {'x':>6}")
    for name, count in counts.items():
        more, longer = count / counts["ideal"], times_ns[name] / times_ns["ideal"]
        print(f"{name:24} {count:12.0f} {more:6.2f} {times_ns[name]:6.0f} {longer:6.2f}")


def counted() -> dict[str, float]:
    """Instructions of a tick by the machine's name."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "out")
        tool = ["valgrind", "--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={out}"]
        command = [*tool, sys.executable, "-m", __spec__.name, "--counted"]
        done = subprocess.run(
            command, cwd=ROOT, env={**os.environ, "CI": "1"}, capture_output=True, check=False
        )
        if done.returncode:
            sys.exit(done.stderr.decode())
        dumps = (Path(f"{out}.{number}") for number in range(1, 1 + len(machines())))
        return dict(zip(machines(), [_total(dump.read_text()) / TICKS for dump in dumps], strict=True))


def timed() -> dict[str, float]:
    """Nanoseconds of a tick by the machine's name."""
    least = dict.fromkeys(machines(), float("inf"))
    for _ in range(ROUNDS):
        for name, machine in machines().items():
            firmware = started(machine)
            before_s = processor_s()
            firmware.advance_to(Instant(10**9))
            least[name] = min(least[name], (processor_s() - before_s) * 1e9 / TICKS)
    return least


def started(machine: Machine) -> Firmware:
    """Return a drive that is about to turn its shaft."""
    firmware = Firmware(*machine)
    firmware.start(EPOCH)
    firmware.control(InnerControl.SPEED)
    firmware.ramp_to_speed(0.5 * machine[0].rated_speed_rad_s, 300.0)
    firmware.inner.load_nm = 0.3
    return firmware


def turn(machine: Machine) -> None:
    """Count one machine into a dump of callgrind's own."""
    firmware = started(machine)
    switch("on")
    firmware.advance_to(Instant(10**9))
    switch("off")
    subprocess.run(["callgrind_control", "--dump=tick", str(os.getpid())], check=True, capture_output=True)


def _total(profile: str) -> int:
    return next(int(line.split()[1]) for line in profile.splitlines() if line.startswith("totals:"))


def machines() -> dict[str, Machine]:
    """Each effect alone on the demo's machine, then all of motion, and all."""
    ideal = FirmwareParameters()
    shaft = Coupling(0.5 * LING.inertia_kg_m2, 0.5 * LING.inertia_kg_m2, 100.0, 0.02, 0.0005)
    rub = Friction(2.0 * LING.coulomb_friction_nm + 0.1, 1.0, LING.coulomb_friction_nm, Side.LOAD)
    cogging = (CoggingHarmonic(24, 0.02), CoggingHarmonic(48, 0.005))
    stops = EndStops(-1e3, 1e5, 100.0, 0.1)
    table = LoadMap((0.0, 0.5, 1.0), (-100.0, 0.0, 100.0), ((-0.1, 0.0, 0.1),) * 3, repeats=True)
    load = PlacedLoad(0.1, Arm(0.2, 20.0), table, stops)
    mechanics = {
        "coupling": Mechanism(replace(shaft, backlash_rad=0.0)),
        "coupling, backlash": Mechanism(shaft),
        "friction": Mechanism(friction=rub),
        "cogging": Mechanism(cogging=cogging),
        "weight and arm": Mechanism(load=PlacedLoad(0.1, Arm(0.2, 20.0))),
        "table of the load": Mechanism(load=PlacedLoad(table=table)),
        "end stops": Mechanism(load=PlacedLoad(stops=stops)),
    }
    motion = Mechanism(shaft, rub, cogging, load)
    encoder = Encoder(1024, SineErrors(0.01, -0.005, 0.01, 0.01), 0.001, 0.5, 12.5e-6)
    edges = SpeedSensing(SpeedMethod.EDGES, 500.0, 1e8)
    supply = Supply(300.0, 0.5, 1e-3, False, 5.0, Chopper(40.0, 380.0, 360.0))
    protection = Protection(400.0, 180.0, 12.0, Overload(3.0, 9.0, 2.0), 140.0, 50)
    sensors = CurrentSensors(20.0, 12, 0.01, -0.005, 0.04, -0.02, 0.02)
    drives = {
        "encoder's errors": replace(ideal, encoder=encoder),
        "speed by edges": replace(ideal, speed=edges),
        "speed by an observer": replace(ideal, speed=SpeedSensing(SpeedMethod.OBSERVER)),
        "current sensors": replace(ideal, current_sensors=sensors),
        "dead time": replace(ideal, inverter=Inverter(1e-6, 0.1, 0.95)),
        "link": replace(ideal, supply=supply),
        "protection": replace(ideal, protection=protection),
        "field": replace(ideal, field=FieldOptions(True, 0.95)),
        "set-point filters": replace(
            ideal, path=SetPointPath(torque_filter_hz=2000.0, notch=Notch(134.0, 0.05, 1.0))
        ),
    }
    inductances = LING.inductance_d_h, LING.inductance_q_h
    steel = iron_of(
        *inductances, LING.flux_linkage_wb, linear_to_a=5.0, at_a=LING.current_max_a, torque_share=0.9
    )
    iron = replace(LING, iron=steel)
    every = replace(
        ideal,
        encoder=encoder,
        speed=edges,
        current_sensors=sensors,
        inverter=Inverter(1e-6, 0.1, 0.95),
        supply=supply,
        protection=protection,
        field=FieldOptions(True, 0.95),
        path=drives["set-point filters"].path,
    )
    switches = Switches(-900.0, 900.0, (1.0, 2.0), 3e-3)
    return {
        "ideal": (LING, ideal),
        **{name: (replace(LING, mechanism=found), ideal) for name, found in mechanics.items()},
        "switches": (replace(LING, mechanism=Mechanism(switches=switches)), ideal),
        "iron": (iron, ideal),
        **{name: (LING, found) for name, found in drives.items()},
        "all of motion": (replace(LING, mechanism=motion), ideal),
        "all": (replace(iron, mechanism=replace(motion, switches=switches)), every),
    }


if __name__ == "__main__":
    main()
