"""Output of ``hil design current``: the controller, its margins, and advice.

An impossible design reported as bad input to the user who typed the command.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from servobench.design.errors import DesignError
from servobench.drivers.errors import BenchError
from servobench.hil.terminal.output import print_figures

if TYPE_CHECKING:
    from servobench.hil.studies.current.design import CurrentResult


def print_result(result: "CurrentResult") -> None:
    """Print everything, the figures in the order of ``--json``."""
    print_current(result.figures)
    typer.echo("")
    for line in advice(result.figures):
        typer.echo(line)


def print_current(figures: dict[str, Any]) -> None:
    """Print one figure per line, tables indented."""
    print_figures(figures, text=_text, width=28, gap="  ")


def root_text(value: list[float]) -> str:
    """Format [real, imaginary] of a zero or pole."""
    return f"{value[0]:.6g}" if value[1] == 0.0 else f"{value[0]:.6g}{value[1]:+.6g}j"


def _text(value: Any) -> str:
    if isinstance(value, list):
        return root_text(value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def advice(figures: dict[str, Any]) -> list[str]:
    """Say in plain sentences what the figures mean for a drive."""
    lines = []
    norm, gamma = figures["closed_loop_norm"], figures["gamma"]
    if figures["structure"] != "full":
        lines.append(
            f"The structure {figures['structure']} reaches a norm of {norm:.4g}; gamma_min of the full "
            f"order is {figures['gamma_min']:.4g}."
        )
    elif norm > gamma:
        lines.append(f"The norm {norm:.4g} is above gamma {gamma:.4g}.")
    coupled = figures["robust"]["coupled"]
    speed = f"{coupled['speed_rad_s']:.4g} rad/s"
    if coupled["certified"]:
        lines.append(f"Both axes stay stable at {speed} over +-50 % of r, L_d and L_q.")
    else:
        lines.append(
            f"At {speed} both axes are certain to stay stable for +-{coupled['stable_up_to_percent']:.3g} % "
            "of r, L_d and L_q only, because the drive decouples with the nominal inductances."
        )
    if "sampled" in figures:
        lines += _about_sampling(figures["sampled"])
    return lines


def _about_sampling(sampled: dict[str, Any]) -> list[str]:
    lowest, coupled = sampled["lowest_rate"], sampled["coupled"]
    lines = []
    if lowest["rate_hz"] is None:
        lines.append("No inner rate keeps both axes stable at that speed.")
    else:
        lines.append(
            f"An inner rate of {lowest['rate_hz']:.0f} Hz or more holds a modulus margin of "
            f"{lowest['modulus_margin']:.3g} and keeps both axes stable at speed."
        )
    for name in ("decoupled", "as_asked"):
        if name in coupled and max(coupled[name]) >= 1.0:
            speeds = [w for w, rho in zip(coupled["speed_rad_s"], coupled[name], strict=True) if rho >= 1.0]
            lines.append(f"At {sampled['rate_hz']:g} Hz, {name}: unstable from {min(speeds):.4g} rad/s on.")
    return lines


class DesignRefused(BenchError):
    """The failed assumption or demand, its figures, and the remedy: in the design's own words."""

    exit_status = 2


@contextmanager
def refused(about: str) -> Iterator[None]:
    """Raise DesignRefused, which begins with ``about``, for a DesignError inside."""
    try:
        yield
    except DesignError as error:
        raise DesignRefused(f"{about}: {error}") from error
