"""``hil measure``: what a network does to a cycle, stage by stage."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.errors import BadInput
from hil.terminal.options import (
    EVERY_STREAM,
    BitrateOption,
    DriveMotorOption,
    JsonOption,
    bus_option,
    fault_plan,
    faults_option,
    flag,
    motor_file,
    valued,
)
from hil.terminal.output import put, say
from hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from hil.measuring.figures import Measured
    from hil.measuring.subject import MeasureRequest

PICTURES = (".png", ".svg", ".pdf")
CYCLES_MAX = 1_000_000
"""Each takes half a kilobyte of memory a drive, which is taken before the first."""

BusOption = Annotated[str, bus_option("simulated, hub:NAME, socketcan:can0, or INTERFACE:CHANNEL.")]
NodeOption = Annotated[list[str], valued("--node", "N...", "Node ids: 1, or 1,2, or 1-3; may be repeated.")]
MoreNodes = Annotated[list[str] | None, typer.Argument(metavar="[N...]", hidden=True)]
CyclesOption = Annotated[int, typer.Option("--cycles", min=100, max=CYCLES_MAX, help="How many SYNCs.")]
PeriodOption = Annotated[int, typer.Option("--period-us", min=250, max=100_000, help="Between two SYNCs.")]
EnableOption = Annotated[
    bool,
    flag("--enable", "Enable the drives and have them follow small torques: the shafts move."),
]
TorqueOption = Annotated[
    float | None, valued("--torque-max-nm", "X", "Largest torque; 3 % of the rated one if absent.")
]
SpeedOption = Annotated[
    float, typer.Option("--speed-max-rpm", min=1.0, help="An enabled drive that turns faster is stopped.")
]
OutOption = Annotated[Path | None, valued("--out", "NETWORK.toml", "Write the network, for hil design.")]
FaultsOutOption = Annotated[
    Path | None, valued("--faults-out", "FAULTS.toml", "Write it as a fault plan, to replay it.")
]
PictureOption = Annotated[Path | None, valued("--picture", "FILE", "Draw the histograms: .png, .svg, .pdf.")]
FaultsOption = Annotated[Path | None, faults_option("host")]
SeedOption = Annotated[int, EVERY_STREAM]


def measure(
    bus: BusOption,
    node: NodeOption,
    more_nodes: MoreNodes = None,
    cycles: CyclesOption = 10_000,
    period_us: PeriodOption = 1000,
    enable: EnableOption = False,
    torque_max_nm: TorqueOption = None,
    speed_max_rpm: SpeedOption = 100.0,
    out: OutOption = None,
    faults_out: FaultsOutOption = None,
    picture: PictureOption = None,
    motor: DriveMotorOption = None,
    faults: FaultsOption = None,
    bitrate: BitrateOption = 1_000_000,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure a network: delay of each stage of a cycle, losses both ways, the drives' clocks.

    The drives stay disabled unless --enable. What is changed in them is put back; after a crash
    runs/measure-TIME has what hil restore needs.

    Exit status: 0 measured, 1 not to be trusted, 2 bad input, 3 bus or drive fault, 130 ended by a signal.
    """
    from drivers.rotation import RAD_S_PER_RPM
    from hil.measuring.subject import MeasureRequest
    from hil.terminal.measure_report import print_measured
    from hil.terminal.node_list import drive_ids

    _require_places({"--out": out, "--faults-out": faults_out, "--picture": picture})
    request = MeasureRequest(
        bus=bus,
        nodes=tuple(drive_ids([*node, *(more_nodes or [])])),
        cycles=cycles,
        period_us=period_us,
        bitrate_bit_s=bitrate,
        enable=enable,
        torque_max_nm=torque_max_nm,
        speed_max_rad_s=speed_max_rpm * RAD_S_PER_RPM,
        motor=motor_file(motor, "--motor").parameters if motor else None,
        faults=fault_plan(faults),
        seed=seed,
    )
    measured = _measured(request)
    put(measured.as_json(), as_json, lambda _figures: print_measured(measured))
    if measured.interrupted:
        raise typer.Exit(ExitStatus.INTERRUPTED)
    _write_files(measured, out, faults_out, picture)
    raise typer.Exit(ExitStatus.FAILED if measured.distrust else ExitStatus.PASSED)


def _measured(request: "MeasureRequest") -> "Measured":
    from hil.machine.progress import TerminalProgress
    from hil.measuring.measure import run_measurement

    progress = TerminalProgress(sys.stderr, request.cycles * request.period_us * 1e-6)
    try:
        return run_measurement(request, lambda text: say(f"hil: {text}"), progress)
    finally:
        progress.clear()


def _require_places(files: Mapping[str, Path | None]) -> None:
    """Raises BadInput for an option whose file could not be written, before anything is measured."""
    for option, path in files.items():
        if path is None:
            continue
        if path.is_dir() or not path.parent.is_dir():
            raise BadInput(option, "", str(path), "a file in a folder that is there")
        if option == "--picture" and path.suffix not in PICTURES:
            raise BadInput(option, "", str(path), f"a file that ends in {', '.join(PICTURES)}")


def _write_files(
    measured: "Measured", out: Path | None, faults_out: Path | None, picture: Path | None
) -> None:
    """Write what is asked for. Raises BadInput for a file that cannot be written."""
    from drivers.bounded_file import write_file, writing
    from hil.configuration.network_file import network_text
    from hil.measuring.figures import fault_plan_text
    from hil.measuring.picture import draw_stages

    if out is not None and measured.network is not None:
        head = f"# Measured on {measured.request.bus} by hil measure.\n\n"
        write_file("--out", out, head + network_text(measured.network))
        say(f"written: {out}")
    if faults_out is not None:
        write_file("--faults-out", faults_out, fault_plan_text(measured))
        say(f"written: {faults_out}")
    if picture is not None:
        with writing("--picture", picture):
            draw_stages(picture, measured)
        say(f"written: {picture}")
