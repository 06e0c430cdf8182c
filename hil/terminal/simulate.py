"""``hil simulate``: simulated drives in a separate process."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from servobench.hil.terminal.options import (
    BitrateOption,
    DriveFaultsOption,
    DriveMotorOption,
    SeedOption,
    bus_option,
    fault_plan,
    flag,
    motor_file,
    valued,
)
from servobench.hil.terminal.output import say


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulateOptions:
    """Options of ``hil simulate``."""

    bus: Annotated[str, bus_option("A real-time bus: hub:NAME, socketcan:vcan0, ...")]
    node: Annotated[
        list[str] | None,
        valued(
            "--node",
            "N...",
            "Node ids: 1, or 1,2, or 1-3, or unconfigured, "
            "or unconfigured:3 (LSS assigns one); repeatable. "
            "Default: that of the DCF.",
        ),
    ] = None
    more_nodes: Annotated[list[str] | None, typer.Argument(metavar="[N...]", hidden=True)] = None
    serial: Annotated[
        list[str] | None,
        valued(
            "--serial",
            "N...",
            "Serial numbers (1018h:04), one per node, or the first to count up from. "
            "Default: the node id, and 255, 256 ... for nodes without.",
        ),
    ] = None
    motor: DriveMotorOption = None
    like: Annotated[
        Path | None,
        valued(
            "--like",
            "NAME",
            "A preset of hil presets, or a file: supply, sensors and the like; simulation.like of a bench.",
        ),
    ] = None
    faults: DriveFaultsOption = None
    eds: Annotated[
        Path | None, valued("--eds", "FILE", "EDS, DCF, XDD or XDC of the device to simulate.")
    ] = None
    store: Annotated[
        Path | None, valued("--store", "FILE", "File for 1010h and LSS to store to; created on first use.")
    ] = None
    export_eds: Annotated[
        Path | None, valued("--export-eds", "FILE", "Write the EDS of the simulated drive to this file.")
    ] = None
    background: Annotated[
        Path | None, valued("--background", "FILE", "Other nodes' traffic: a file of tables 'background'.")
    ] = None
    load: Annotated[
        list[str] | None,
        valued(
            "--load",
            "NODE=FILE",
            "CSV or Parquet with time_s and torque_nm, a load that a bench can apply; repeatable.",
        ),
    ] = None
    load_machine: Annotated[
        Path | None,
        valued(
            "--load-machine",
            "PATH",
            "Magtrol dynamometer on the first drive's shaft; PATH: link to create to its serial port.",
        ),
    ] = None
    load_machine_fault: Annotated[
        list[str] | None,
        valued(
            "--load-machine-fault",
            "NAME=VALUE",
            "A fault of its serial line, e.g. garble=0.01, terminator=0.1, baud=9600; repeatable.",
        ),
    ] = None
    current_control: Annotated[
        list[Path] | None,
        valued("--current-control", "FILE", "Current controller of the q or d axis, repeatable."),
    ] = None
    gain_objects: Annotated[
        bool,
        flag("--gain-objects", "Objects for the gains of the drive's own loops: 2121h, or its maker's."),
    ] = False
    bitrate: BitrateOption = 1_000_000
    force: Annotated[bool, flag("--force", "Join even if a node with the same id is on the bus.")] = False
    seed: SeedOption = None


def simulate(asked: SimulateOptions) -> None:
    """Simulate drives in a separate process on a real-time bus, until Ctrl-C.

    Examples:
      hil simulate --bus hub:lab --node 1,2 --export-eds drive.eds &
    """
    from servobench.drivers.bounded_file import NamedBy
    from servobench.hil.configuration.config import load_background
    from servobench.hil.configuration.drive_model import load_drive_model
    from servobench.hil.configuration.motor_file import LING2012
    from servobench.hil.execution.device_files import DeviceFiles
    from servobench.hil.load.simulated_load import load_tables
    from servobench.hil.terminal.options import node_ids, serial_numbers

    files = DeviceFiles(asked.eds, asked.store, asked.export_eds)
    typed = [*(asked.node or []), *(asked.more_nodes or [])]
    if not typed and (commissioned := files.commissioned_node()) is not None:
        typed = [str(commissioned)]
    nodes = node_ids(typed)
    parameters = (motor_file(asked.motor, "--motor") if asked.motor else LING2012).parameters
    named_by = NamedBy("--background", "", str(asked.background))
    others = load_background(asked.background, named_by) if asked.background else ()

    like = load_drive_model(asked.like, NamedBy("--like", "", str(asked.like))) if asked.like else None

    from servobench.hil.execution.simulated_drives import simulate as simulate_drives
    from servobench.hil.load.simulated_load import SimulatedLoadMachine

    instrument = SimulatedLoadMachine.wanted(asked.load_machine, asked.load_machine_fault or [], parameters)
    simulate_drives(
        bus_spec=asked.bus,
        nodes=nodes,
        serials=serial_numbers(asked.serial or [], len(nodes)),
        motor=parameters,
        faults=fault_plan(asked.faults),
        bitrate_bit_s=asked.bitrate,
        seed=asked.seed or 0,
        announce=say,
        files=files,
        background=others,
        current_control=asked.current_control or (),
        like=like,
        gain_objects=asked.gain_objects,
        loads=load_tables(asked.load or [], nodes),
        load_machine=instrument,
        force=asked.force,
    )
