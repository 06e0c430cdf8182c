"""Simulated drives for rehearsing a commissioning: an unknown one, or one by its data sheet.

In simulated time, with the commissioning itself (:func:`rehearsed_drive`), or in a separate process on a
real-time bus: the unknown one by ``hil rehearse``, the one of a data sheet by ``hil simulate --eds``.
"""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from servobench.drivers.cia402.scaling import ENCODER_COUNTS_MIN
from servobench.drivers.wire.adapters import shared_bus
from servobench.drivers.written_file import write_file
from servobench.hil.commissioning.request import Rehearsal
from servobench.hil.configuration.toml_text import toml_text
from servobench.hil.execution.device_files import DeviceFiles
from servobench.hil.execution.simulated_drives import host_drives, servo_of
from servobench.hil.execution.world import WorldPlan
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import Truth, nameplate_of, unknown_drive
from servobench.virtual_bus.hosting.injection import Faults


def rehearsed_drive(
    rehearsal: Rehearsal, node: int, bitrate_bit_s: int, announce: Callable[[str], None]
) -> tuple[SimulatedServo, dict[str, Any]]:
    """Return the simulated drive, and its nameplate, as tables of a nameplate file. Raises BadInput.

    A data sheet need not define the position unit: the nameplate then names the encoder.
    """
    if rehearsal.eds is None:
        servo, truth = unknown_drive(rehearsal.seed or 0, node)
        return servo, truth.nameplate
    motor = rehearsal.motor.parameters
    files = DeviceFiles(eds=rehearsal.eds)
    servo = servo_of(files, node, motor, DriveParameters(), announce=announce, bitrate_bit_s=bitrate_bit_s)
    units, encoder_counts = servo.drive.units, servo.drive.drive.encoder_counts_per_revolution
    units.take()
    counts = round(encoder_counts / abs(units.counts_per_position))
    encoder = {"encoder": {"counts_per_revolution": counts}} if counts >= ENCODER_COUNTS_MIN else {}
    return servo, nameplate_of(motor) | encoder


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
    spec = shared_bus(bus_spec, "in simulated time: hil commission --bus simulated --rehearse SEED")
    servo, truth = unknown_drive(seed, node, DriveParameters(clock_drift_ppm=clock_drift_ppm))
    if nameplate is not None:
        text = f"# What is printed on motor and drive of seed {seed}.\n\n{toml_text(truth.nameplate)}"
        write_file("--nameplate", nameplate, text)
    if truth_file is not None:
        text = "# What commissioning has to find out. Not for its eyes.\n\n" + toml_text(truth_tables(truth))
        write_file("--truth", truth_file, text)
    plan = WorldPlan(spec, bitrate_bit_s, faults=faults, seed=seed, side="drive")
    title = f"unknown drive of seed {seed} on {spec}: node {node}; Ctrl-C ends it"
    host_drives(plan, [servo], [node], title, announce)


def truth_tables(truth: Truth) -> dict[str, Any]:
    """Return the hidden data, as tables of a file."""
    motor = {name: value for name, value in asdict(truth.motor).items() if value is not None}
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
