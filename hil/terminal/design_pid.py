"""``hil design pid``: a PID speed loop for a drive behind the bus, by a stated rule."""

import json
from pathlib import Path
from typing import Annotated

import typer

from hil.terminal.exit_status import reported_errors


def pid(
    motor: Annotated[Path, typer.Argument(metavar="MOTOR.toml", help="The motor file.")],
    current_control: Annotated[
        Path | None,
        typer.Option("--current-control", metavar="FILE", help="The q axis' controller; PI if absent."),
    ] = None,
    current_bandwidth_hz: Annotated[
        float, typer.Option("--current-bandwidth-hz", min=1.0, help="Of the PI, without --current-control.")
    ] = 800.0,
    period_ms: Annotated[float, typer.Option("--period-ms", min=0.01, help="The host's period.")] = 1.0,
    latency_ms: Annotated[
        float, typer.Option("--latency-ms", min=0.0, help="From a reading to its torque, without the hold.")
    ] = 1.0,
    phase_margin_deg: Annotated[
        float, typer.Option("--phase-margin-deg", min=10.0, max=85.0, help="To be kept.")
    ] = 50.0,
    integral_ratio: Annotated[
        float, typer.Option("--integral-ratio", min=1.0, help="Integral time times crossover.")
    ] = 40.0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="The controller, for a bench file.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object on stdout, all else on stderr.")
    ] = False,
) -> None:
    """Tune a PID speed loop: Td from the current loop, the crossover from the phase margin and the delay."""
    with reported_errors():
        from drivers.bounded_file import NamedBy
        from hil.configuration.motor_file import load_motor
        from hil.current_control import write_text
        from hil.speed_pid import PidRequest, controller_text, design_pid, pid_figures
        from hil.terminal.current_report import print_figures
        from hil.terminal.design_errors import refused

        request = PidRequest(
            motor=load_motor(motor, NamedBy("MOTOR.toml", "", str(motor))).parameters,
            current_control=current_control,
            current_bandwidth_hz=current_bandwidth_hz,
            period_s=1e-3 * period_ms,
            latency_s=1e-3 * latency_ms,
            phase_margin_deg=phase_margin_deg,
            ratio=integral_ratio,
        )
        with refused(str(motor)):
            found = design_pid(request)
        if as_json:
            typer.echo(json.dumps(pid_figures(found), allow_nan=False))
        else:
            print_figures(pid_figures(found))
        if out is not None:
            write_text(out, controller_text(request, found))
            typer.echo(f"written {out}", err=True)
