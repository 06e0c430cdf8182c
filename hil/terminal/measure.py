"""``hil measure``: the effect of a network on a cycle, stage by stage."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.machine.parent_process import messages, tell_parent
from servobench.hil.terminal.commands import end_with
from servobench.hil.terminal.options import (
    EVERY_STREAM,
    AllowOption,
    BitrateOption,
    DriveMotorOption,
    JsonOption,
    allowed,
    bus_option,
    fault_plan,
    faults_option,
    flag,
    given,
    motor_file,
    valued,
)
from servobench.hil.terminal.output import put, say
from servobench.hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from servobench.hil.measuring.figures import Measured
    from servobench.hil.measuring.subject import MeasureRequest

PICTURES = (".png", ".svg", ".pdf")
CYCLES_MAX = 1_000_000
"""Each takes half a kilobyte of memory per drive, allocated before the first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureOptions:
    """Options of ``hil measure``."""

    bus: Annotated[str, bus_option("simulated, hub:NAME, socketcan:can0, or INTERFACE:CHANNEL.")]
    node: Annotated[list[str], valued("--node", "N...", "Node ids: 1, or 1,2, or 1-3; repeatable.")]
    more_nodes: Annotated[list[str] | None, typer.Argument(metavar="[N...]", hidden=True)] = None
    cycles: Annotated[int, valued("--cycles", None, "Number of SYNCs.", min=100, max=CYCLES_MAX)] = 10_000
    period_us: Annotated[int, valued("--period-us", None, "Period of the SYNC.", min=250, max=100_000)] = 1000
    enable: Annotated[
        bool, flag("--enable", "Enable the drives and command small torques: the shafts move.")
    ] = False
    torque_max_nm: Annotated[
        float | None, valued("--torque-max-nm", "X", "Largest torque; default: 3 % of rated.")
    ] = None
    speed_max_rpm: Annotated[
        float, valued("--speed-max-rpm", None, "Speed at which an enabled drive is stopped.", min=1.0)
    ] = 100.0
    out: Annotated[Path | None, valued("--out", "NETWORK.toml", "Write the network, for hil design.")] = None
    faults_out: Annotated[
        Path | None, valued("--faults-out", "FAULTS.toml", "Write the network as a fault plan, to replay it.")
    ] = None
    picture: Annotated[Path | None, valued("--picture", "FILE", "Draw the histograms: .png, .svg, .pdf.")] = (
        None
    )
    allow: AllowOption = None
    motor: DriveMotorOption = None
    faults: Annotated[Path | None, faults_option("host")] = None
    bitrate: BitrateOption = 1_000_000
    seed: Annotated[int, EVERY_STREAM] = 0
    as_json: JsonOption = False


def measure(asked: MeasureOptions) -> None:
    """Measure a network: delay of each stage of a cycle, losses both ways, the drives' clocks.

    The drives stay disabled unless --enable. Changes in them are undone; after a crash runs/measure-TIME
    holds the journal for hil restore.

    Exit status: 0 measured, 1 not trustworthy, 2 bad input, 3 bus or drive fault, 4 disturbed by others, 130
    ended by a signal.

    Examples:
      hil measure --bus simulated --node 1 --cycles 1000 --out network.toml
      hil measure --bus simulated --node 1 --enable --cycles 1000 --out n.toml
    """
    from servobench.drivers.rotation import RAD_S_PER_RPM
    from servobench.hil.execution.bench import RUNS_FOLDER
    from servobench.hil.measuring.subject import MeasureRequest
    from servobench.hil.terminal.measure_report import print_measured
    from servobench.hil.terminal.options import drive_ids

    _require_places(asked)
    request = MeasureRequest(
        bus=asked.bus,
        nodes=tuple(drive_ids([*asked.node, *(asked.more_nodes or [])])),
        cycles=asked.cycles,
        period_us=asked.period_us,
        bitrate_bit_s=asked.bitrate,
        enable=asked.enable,
        torque_max_nm=asked.torque_max_nm,
        speed_max_rad_s=asked.speed_max_rpm * RAD_S_PER_RPM,
        motor=motor_file(asked.motor, "--motor").parameters if asked.motor else None,
        faults=fault_plan(asked.faults),
        seed=asked.seed,
        allow=allowed(asked.allow),
    )
    advice = f"hil restore puts back what was changed, by the journals in {RUNS_FOLDER}/measure-*"
    if asked.enable:
        tell_parent(bus=asked.bus, bitrate=asked.bitrate, nodes=list(request.nodes))
    tell_parent(advice=advice)
    measured = _measured(request)
    put(measured.as_json(), asked.as_json, lambda _figures: print_measured(measured))
    if measured.interrupted:
        end_with(ExitStatus.INTERRUPTED)
    _write_files(measured, asked)
    end_with(_status(measured))


def _status(measured: "Measured") -> ExitStatus:
    if measured.distrust:
        return ExitStatus.FAILED
    return ExitStatus.NOT_TRUSTWORTHY if measured.disturbances else ExitStatus.PASSED


def _measured(request: "MeasureRequest") -> "Measured":
    from servobench.hil.machine.progress import TerminalProgress
    from servobench.hil.measuring.measure import run_measurement

    progress = TerminalProgress(messages(), request.cycles * request.period_us * 1e-6)
    try:
        return run_measurement(request, lambda text: say(f"hil: {text}"), progress)
    finally:
        progress.clear()


def _require_places(asked: MeasureOptions) -> None:
    """Raise BadInput for an option whose file could not be written, before anything is measured."""
    for option, path in given(asked, "out", "faults_out", "picture").items():
        if path.is_dir() or not path.parent.is_dir():
            raise BadInput(option, "", str(path), "a file in an existing folder")
        if option == "--picture" and path.suffix not in PICTURES:
            raise BadInput(option, "", str(path), f"a file that ends in {', '.join(PICTURES)}")


def _write_files(measured: "Measured", asked: MeasureOptions) -> None:
    """Write the requested files. Raises BadInput for a file that cannot be written."""
    from servobench.drivers.written_file import write_file, written
    from servobench.hil.configuration.network_file import network_text
    from servobench.hil.measuring.figures import fault_plan_text
    from servobench.hil.measuring.picture import draw_stages

    if asked.out is not None and measured.network is not None:
        head = f"# Measured on {measured.request.bus} by hil measure.\n\n"
        write_file("--out", asked.out, head + network_text(measured.network))
        say(f"written: {asked.out}")
    if asked.faults_out is not None:
        write_file("--faults-out", asked.faults_out, fault_plan_text(measured))
        say(f"written: {asked.faults_out}")
    if asked.picture is not None:
        with written("--picture", asked.picture) as place:
            draw_stages(place, measured)
        say(f"written: {asked.picture}")
