"""``hil design pid``: a PID speed loop for a drive behind the bus, by a stated rule."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.errors import BadInput
from hil.terminal.current_loop_options import (
    AxisOption,
    BenchOption,
    CommissionedOption,
    CurrentBandwidthOption,
    bench_axis,
    current_loop,
    loop_of_bench,
)
from hil.terminal.options import ControllerOutOption, JsonOption, MotorArgument, motor_file
from hil.terminal.output import put, say_written

if TYPE_CHECKING:
    from hil.configuration.current_controller_file import CurrentController


def pid(
    motor: MotorArgument,
    current_control: Annotated[
        Path | None,
        typer.Option(
            "--current-control",
            metavar="FILE",
            help="The q axis' controller, in place of --bench; PI if absent.",
        ),
    ] = None,
    bench: BenchOption = None,
    axis: AxisOption = None,
    commissioned: CommissionedOption = None,
    current_bandwidth_hz: CurrentBandwidthOption = None,
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
    out: ControllerOutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Tune a PID speed loop: Td from the current loop, the crossover from the phase margin and the delay."""
    from design.speed.speed_pid import pid_by_rule
    from drivers.bounded_file import write_file
    from hil.studies.speed.controller_text import controller_text
    from hil.studies.speed.pid import controller_of, current_loop_of, pid_figures
    from hil.terminal.current_report import print_current
    from hil.terminal.design_errors import refused

    controller, loop_hz = _current_loop(current_control, bench, axis, commissioned, current_bandwidth_hz)
    parameters = motor_file(motor).parameters
    closed, crossover = current_loop_of(parameters, controller, loop_hz)
    period_s, latency_s = 1e-3 * period_ms, 1e-3 * latency_ms
    with refused(str(motor)):
        gains = pid_by_rule(
            parameters, closed, crossover, period_s, latency_s, phase_margin_deg, integral_ratio
        )
    put(pid_figures(gains), as_json, print_current)
    if out is not None:
        write_file("--out", out, controller_text(controller_of(parameters, closed.order, crossover, gains)))
        say_written(out)


def _current_loop(
    current_control: Path | None,
    bench: Path | None,
    axis: str | None,
    commissioned: Path | None,
    bandwidth_hz: float | None,
) -> "tuple[CurrentController | None, float]":
    """The drive's own controller, or None and the bandwidth of its PI. Raises BadInput or BadInputs."""
    from drivers.bounded_file import NamedBy
    from hil.configuration.current_controller_file import load_current_controller

    if current_control is not None:
        others = {"--bench": bench, "--commissioned": commissioned, "--current-bandwidth-hz": bandwidth_hz}
        for option, value in others.items():
            if value is not None:
                raise BadInput(option, "", str(value), f"either --current-control or {option}")
        named_by = NamedBy("--current-control", "", str(current_control))
        return load_current_controller(current_control, named_by, "q"), 0.0
    if bench is not None and commissioned is None and bandwidth_hz is None:
        config, name = bench_axis(bench, axis)
        loop = loop_of_bench(config, name)
        controller = config.drive[name].current_control.controller
        return (controller if loop.order != 1 else None), loop.bandwidth_hz
    return None, current_loop(bench, axis, commissioned, bandwidth_hz).bandwidth_hz
