"""A drive that nobody has described, on a bus of its own process, to rehearse commissioning with."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drivers.errors import BadInput
from drivers.wire.adapters import parse_bus_spec
from hil.configuration.toml_text import toml_text
from hil.execution.node_ids_taken import refuse_taken
from hil.execution.world import WorldPlan, open_world
from hil.machine.realtime import realtime_process
from hil.machine.stopping import stop_signals
from virtual_bus.drive.unknown_drive import Truth, unknown_drive
from virtual_bus.frame import Device
from virtual_bus.hosting.devices import serve
from virtual_bus.hosting.injection import Faults


def rehearse(
    *,
    bus_spec: str,
    node: int,
    seed: int,
    nameplate: Path | None,
    truth_file: Path | None,
    faults: Faults | None,
    clock_drift_ppm: float,
    bitrate_bit_s: int,
    announce: Callable[[str], None],
) -> None:
    """Serve the drive of ``seed`` until a stop signal comes; the two files are written first.

    Raises BadInput for a bus in simulated time, BusDown if the bus cannot be opened or goes away.
    """
    spec = parse_bus_spec(bus_spec, "--bus")
    if spec.simulated:
        raise BadInput(
            "--bus", "", bus_spec, "a bus that other processes can join",
            "in simulated time: hil commission --bus simulated --rehearse SEED",
        )  # fmt: skip
    servo, truth = unknown_drive(seed, node, clock_drift_ppm)
    if nameplate is not None:
        text = f"# What is printed on motor and drive of seed {seed}.\n\n{toml_text(truth.nameplate)}"
        _write(nameplate, text, "--nameplate")
    if truth_file is not None:
        text = "# What commissioning has to find out. Not for its eyes.\n\n" + toml_text(truth_tables(truth))
        _write(truth_file, text, "--truth")
    plan = WorldPlan(spec, bitrate_bit_s, False, faults, seed, side="drive")
    with stop_signals() as stop, open_world(plan, ()) as world:
        refuse_taken(world.link, world.clock, [node], announce, force=False)
        device: Device = servo
        if world.faults is not None:
            device = world.faults.wrap(servo)
            world.faults.start(world.clock.now())
        with realtime_process() as refused:
            for request in refused:
                announce(f"not granted by the kernel: {request}")
            announce(f"unknown drive of seed {seed} on {spec}: node {node}; Ctrl-C ends it")
            serve([device], world.link.bus, world.clock, stop)


def truth_tables(truth: Truth) -> dict[str, Any]:
    """What is hidden, as tables of a file."""
    motor = asdict(truth.motor)
    motor["transform"] = truth.motor.transform.value
    return {
        "units": {
            "counts_per_revolution": truth.counts_per_revolution,
            "position_rad": truth.position_rad,
            "velocity_rad_s": truth.velocity_rad_s,
            "rated_torque_nm": truth.rated_torque_nm,
            "position_sign": truth.position_sign,
            "velocity_sign": truth.velocity_sign,
            "faults": sorted(truth.faults),
        },
        "motor": motor,
    }


def _write(path: Path, text: str, option: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BadInput(option, "", str(path), "a file that can be written", error.strerror or "") from error
