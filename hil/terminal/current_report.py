"""What ``hil design current`` prints: the controller, its margins, its bounds as a picture, and advice."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import typer

from design.hinf.mixed_sensitivity import loop_functions
from hil.terminal.output import print_figures

if TYPE_CHECKING:
    from design.current.current_design import AxisDesign
    from hil.studies.current.design import CurrentResult


_POINTS = 220
"""Three to a column of the picture, so that a steep flank has few gaps."""


def print_result(result: "CurrentResult") -> None:
    """Everything, the figures in the order of ``--json``."""
    print_current(result.figures)
    typer.echo("")
    typer.echo(bounds_picture(result.chosen))
    for line in advice(result.figures):
        typer.echo(line)


def print_current(figures: dict[str, Any]) -> None:
    """A figure a line, tables indented."""
    print_figures(figures, text=_text, width=28, gap="  ")


def root_text(value: list[float]) -> str:
    """[real, imaginary] of a zero or pole."""
    return f"{value[0]:.6g}" if value[1] == 0.0 else f"{value[0]:.6g}{value[1]:+.6g}j"


def _text(value: Any) -> str:
    if isinstance(value, list):
        return root_text(value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def bounds_picture(design: "AxisDesign") -> str:
    """|S|, |KS| and |T| (letters) under their bounds 1/|w| (dots)."""
    crossover = design.margins.phase_margin_rad_s
    omega = crossover * np.logspace(-4.0, 3.5, _POINTS)
    gains = loop_functions(design.plant, design.controller, omega)
    weights = design.weights.by_function
    parts = []
    for name, gain in gains.items():
        bound = -20.0 * np.log10([weights[name].gain(float(w)) for w in omega])
        shown = 20.0 * np.log10(np.maximum(gain, 1e-12))
        top = 10.0 * np.ceil(0.1 * max(bound.max(), shown.max()))
        span = max(60.0, 10.0 * np.ceil(0.1 * (top - max(bound.min(), -100.0))))
        curves = {".": bound.tolist(), name[0]: shown.tolist()}
        parts.append(plot(f"|{name}| and its bound (.)", omega.tolist(), curves, (top - span, top)))
    return "\n".join(parts)


def advice(figures: dict[str, Any]) -> list[str]:
    """Plain sentences about what the figures mean for a drive."""
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


WIDTH, HEIGHT = 64, 11


def plot(
    title: str,
    frequency_rad_s: Sequence[float],
    curves: Mapping[str, Sequence[float]],
    range_db: tuple[float, float],
) -> str:
    """Each curve (k,) in dB by the letter it is named with, over the logarithm of the k frequencies.

    A curve that is named later is drawn over the ones before it.
    """
    low, high = range_db
    ends = math.log10(frequency_rad_s[0]), math.log10(frequency_rad_s[-1])
    rows = [[" "] * WIDTH for _ in range(HEIGHT)]
    for letter, values in curves.items():
        for omega, value in zip(frequency_rad_s, values, strict=True):
            column = round((math.log10(omega) - ends[0]) / (ends[1] - ends[0]) * (WIDTH - 1))
            row = round((high - value) / (high - low) * (HEIGHT - 1))
            if 0 <= row < HEIGHT:
                rows[row][column] = letter
    step = (high - low) / (HEIGHT - 1)
    lines = [f"{high - step * k:8.0f} |{''.join(row).rstrip()}" for k, row in enumerate(rows)]
    left, right = f"{frequency_rad_s[0]:.0e}", f"{frequency_rad_s[-1]:.0e} rad/s"
    axis = f"{left}{right:>{WIDTH - len(left)}}"
    return "\n".join([f"{title}, dB", *lines, f"{'':8} +{'-' * WIDTH}", f"{'':10}{axis}"])
