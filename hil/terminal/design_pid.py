"""``hil design pid``: a PID speed loop for a drive behind the bus, by a stated rule."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.current_loop_options import CurrentLoopOptions, bench_axis, loop_of_bench
from servobench.hil.terminal.options import (
    ControllerOutOption,
    JsonOption,
    MotorArgument,
    rigid_motor,
    valued,
)
from servobench.hil.terminal.output import put, say_written

if TYPE_CHECKING:
    from servobench.hil.configuration.controller_files import CurrentController


@dataclass(frozen=True, slots=True, kw_only=True)
class PidOptions:
    """Options of ``hil design pid``."""

    motor: MotorArgument
    current_control: Annotated[
        Path | None,
        valued("--current-control", "FILE", "Controller of the q axis, instead of --bench; default: PI."),
    ] = None
    current_loop: CurrentLoopOptions
    period_ms: Annotated[float, valued("--period-ms", None, "The host's period.", min=0.01)] = 1.0
    latency_ms: Annotated[
        float, valued("--latency-ms", None, "Delay from a reading to its torque, without the hold.", min=0.0)
    ] = 1.0
    phase_margin_deg: Annotated[
        float, valued("--phase-margin-deg", None, "To be kept.", min=10.0, max=85.0)
    ] = 50.0
    integral_ratio: Annotated[
        float, valued("--integral-ratio", None, "Integral time times crossover.", min=1.0)
    ] = 40.0
    out: ControllerOutOption = None
    as_json: JsonOption = False


def pid(asked: PidOptions) -> None:
    """Tune a PID speed loop: Td from the current loop, the crossover from the phase margin and the delay.

    Examples:
      hil design pid motor.toml
    """
    from servobench.design.speed.speed_pid import pid_by_rule
    from servobench.drivers.written_file import write_file
    from servobench.hil.studies.speed.controller_text import controller_text
    from servobench.hil.studies.speed.pid import controller_of, current_loop_of, pid_figures
    from servobench.hil.terminal.current_report import print_current, refused

    controller, loop_hz = _current_loop(asked.current_control, asked.current_loop)
    motor = rigid_motor(asked.motor, knows_coupling=True)
    closed, crossover = current_loop_of(motor, controller, loop_hz)
    with refused(str(asked.motor)):
        gains = pid_by_rule(
            motor,
            closed,
            crossover,
            1e-3 * asked.period_ms,
            1e-3 * asked.latency_ms,
            asked.phase_margin_deg,
            asked.integral_ratio,
        )
    put(pid_figures(gains), asked.as_json, print_current)
    if asked.out is not None:
        write_file("--out", asked.out, controller_text(controller_of(motor, closed.order, crossover, gains)))
        say_written(asked.out)


def _current_loop(
    current_control: Path | None, others: CurrentLoopOptions
) -> "tuple[CurrentController | None, float]":
    """Return the drive's own controller, or None and the bandwidth of its PI. Raises BadInput or
    BadInputs."""
    from servobench.drivers.bounded_file import NamedBy
    from servobench.hil.configuration.controller_files import load_current_controller

    if current_control is not None:
        for option, value in others.sources.items():
            raise BadInput(option, "", str(value), f"either --current-control or {option}")
        named_by = NamedBy("--current-control", "", str(current_control))
        return load_current_controller(current_control, named_by, "q"), 0.0
    if others.bench is not None and len(others.sources) == 1:
        config, name = bench_axis(others.bench, others.axis)
        loop = loop_of_bench(config, name)
        controller = config.drive[name].current_control.controller
        return (controller if loop.order != 1 else None), loop.bandwidth_hz
    return None, others.known_loop().bandwidth_hz
