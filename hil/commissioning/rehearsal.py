"""Simulated drives for rehearsing a commissioning: an unknown one, or one by its data sheet; and the files of
it that accompany the bench of a commissioned drive.

In simulated time, with the commissioning itself (:func:`rehearsed_drive`), or in a separate process on a
real-time bus: the unknown one by ``hil rehearse``, the one of a data sheet by ``hil simulate --eds``.
"""

import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from servobench.drivers.cia402.scaling import ENCODER_COUNTS_MIN
from servobench.drivers.wire.adapters import shared_bus
from servobench.drivers.written_file import write_file
from servobench.hil.commissioning.request import CommissionRequest, Rehearsal
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.execution.device_files import DeviceFiles
from servobench.hil.execution.simulated_drives import host_drives, servo_of
from servobench.hil.execution.world import WorldPlan
from servobench.hil.rows.run_files import BENCH_FILE
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


_SHEET: Final = "data-sheet"
"""The drive's, with its original suffix."""
_REHEARSED_SHEET: Final = "rehearsed"
"""The simulated drive's, if it was commissioned with another one."""
_REHEARSED_MOTOR_FILE: Final = "rehearsed-motor.toml"
_BITRATE_BIT_S: Final = 1_000_000
"""The default of ``--bitrate``."""


def copied_files(request: CommissionRequest) -> dict[str, str]:
    """Copy the data sheets named by the bench next to it; return the other files to write, by name."""
    rehearsal = request.rehearsal
    for sheet, name in (
        (request.eds, sheet_name(request)),
        (None if rehearsal is None else rehearsal.eds, _rehearsed_name(request)),
    ):
        if sheet is not None and not ((request.out / name).exists() and sheet.samefile(request.out / name)):
            shutil.copyfile(sheet, request.out / name)
    if rehearsal is None or rehearsal.eds is None:
        return {}
    return {
        _REHEARSED_MOTOR_FILE: "# The motor on the simulated drive's shaft.\n\n"
        + toml_text(rehearsal.motor.tables)
    }


def sheet_name(request: CommissionRequest) -> str:
    """Return the name of the copy of the drive's data sheet; empty without one."""
    return "" if request.eds is None else f"{_SHEET}{request.eds.suffix}"


def _rehearsed_name(request: CommissionRequest) -> str:
    eds = None if request.rehearsal is None else request.rehearsal.eds
    if eds is None or eds == request.eds:
        return sheet_name(request)
    return f"{_REHEARSED_SHEET}{eds.suffix}"


def simulation_table(request: CommissionRequest) -> dict[str, Any]:
    """Return the rehearsed drive as a bench table."""
    rehearsal = request.rehearsal
    if rehearsal is None:
        return {}
    if rehearsal.eds is None:
        return {"rehearse": rehearsal.seed or 0}
    return {"eds": _rehearsed_name(request), "motor": _REHEARSED_MOTOR_FILE}


def ways_to_run(request: CommissionRequest, folder: Path) -> list[str]:
    """Return commands to run the bench in ``folder`` with its rehearsed drive: as it is, and with the drive
    in another process; empty for a real drive."""
    rehearsal = request.rehearsal
    if rehearsal is None:
        return []
    rate = request.bitrate_bit_s
    shared = f"--bus hub:bench --node {request.node}{'' if rate == _BITRATE_BIT_S else f' --bitrate {rate}'}"
    if rehearsal.eds is None:
        drive = f"hil rehearse {shared} --seed {rehearsal.seed or 0}"
    else:
        sheet, motor = folder / _rehearsed_name(request), folder / _REHEARSED_MOTOR_FILE
        drive = f"hil simulate {shared} --eds {sheet} --motor {motor}"
    bench = folder / BENCH_FILE
    return [
        f"With the rehearsed drive beside it, in simulated time: hil run {bench}",
        f"With it in another process, on a hub or on vcan: {drive}",
        f"and then: hil run {bench} --bus hub:bench",
    ]
