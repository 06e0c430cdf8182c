"""``hil measure``: what a network does to a cycle, stage by stage."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.terminal.exit_status import reported_errors
from hil.terminal.options import EVERY_STREAM, BitrateOption, JsonOption, bus_option, faults_option
from hil.terminal.simulate import MotorOption
from hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from hil.measuring.figures import Measured
    from hil.measuring.request import MeasureRequest

CYCLES_MAX = 1_000_000
"""Each takes half a kilobyte of memory a drive, which is taken before the first."""

BusOption = Annotated[str, bus_option("simulated, hub:NAME, socketcan:can0, or INTERFACE:CHANNEL.")]
NodeOption = Annotated[
    list[str], typer.Option("--node", metavar="N...", help="Node ids: 1, or 1,2, or 1-3; may be repeated.")
]
MoreNodes = Annotated[list[str] | None, typer.Argument(metavar="[N...]", hidden=True)]
CyclesOption = Annotated[int, typer.Option("--cycles", min=100, max=CYCLES_MAX, help="How many SYNCs.")]
PeriodOption = Annotated[int, typer.Option("--period-us", min=250, max=100_000, help="Between two SYNCs.")]
EnableOption = Annotated[
    bool,
    typer.Option("--enable", help="Enable the drives and have them follow small torques: the shafts move."),
]
TorqueOption = Annotated[
    float | None,
    typer.Option("--torque-max-nm", metavar="X", help="Largest torque; 3 % of the rated one if absent."),
]
SpeedOption = Annotated[
    float, typer.Option("--speed-max-rpm", min=1.0, help="An enabled drive that turns faster is stopped.")
]
OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="NETWORK.toml", help="Write the network, for hil design.")
]
FaultsOutOption = Annotated[
    Path | None,
    typer.Option("--faults-out", metavar="FAULTS.toml", help="Write it as a fault plan, to replay it."),
]
PictureOption = Annotated[
    Path | None, typer.Option("--picture", metavar="FILE", help="Draw the histograms: .png, .svg, .pdf.")
]
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
    motor: MotorOption = None,
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
    with reported_errors():
        from drivers.bounded_file import NamedBy
        from drivers.rotation import RAD_S_PER_RPM
        from hil.configuration.bench_file import load_faults
        from hil.configuration.motor_file import load_motor
        from hil.measuring.request import MeasureRequest
        from hil.terminal.measure_files import require_places, write_files
        from hil.terminal.node_list import drive_ids

        require_places({"--out": out, "--faults-out": faults_out, "--picture": picture})
        plan = load_faults(faults, NamedBy("--faults", "", str(faults))).plan if faults else None
        motor_file = load_motor(motor, NamedBy("--motor", "", str(motor))) if motor else None
        request = MeasureRequest(
            bus=bus,
            nodes=tuple(drive_ids([*node, *(more_nodes or [])])),
            cycles=cycles,
            period_us=period_us,
            bitrate_bit_s=bitrate,
            enable=enable,
            torque_max_nm=torque_max_nm,
            speed_max_rad_s=speed_max_rpm * RAD_S_PER_RPM,
            motor=motor_file.parameters if motor_file else None,
            faults=plan,
            seed=seed,
        )
        measured = _measured(request)
        _show(measured, as_json=as_json)
        if not measured.interrupted:
            for line in write_files(measured, out, faults_out, picture):
                print(line, file=sys.stderr)
        if measured.interrupted:
            raise typer.Exit(ExitStatus.INTERRUPTED)
        raise typer.Exit(ExitStatus.FAILED if measured.distrust else ExitStatus.PASSED)


def _measured(request: "MeasureRequest") -> "Measured":
    from hil.machine.progress import TerminalProgress
    from hil.measuring.command import run_measurement

    progress = TerminalProgress(sys.stderr, request.cycles * request.period_us * 1e-6)
    try:
        return run_measurement(
            request, lambda text: print(f"hil: {text}", file=sys.stderr, flush=True), progress
        )
    finally:
        progress.clear()


def _show(measured: "Measured", *, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(measured.as_json(), allow_nan=False))
        return
    from hil.terminal.measure_report import print_measured

    print_measured(measured)
