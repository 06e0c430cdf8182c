"""``hil design speed --structure predictor``: the design, its figures, and the controller file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from design.motor import PmsmParameters
from design.sampled.analysis import SampledAnalysis
from design.speed.loss_certificate import predictor_losses, with_losses
from design.speed.predictor_design import (
    LOST,
    PredictorDesign,
    PredictorRequest,
    PredictorRobustness,
    design_predictor,
    predictor_robustness,
)
from design.speed.predictor_plant import encoder_noise_rad_s
from design.speed.predictor_trial import Walks
from drivers.errors import BadInput
from hil.configuration.config_files import Section
from hil.configuration.predictor_section import PredictorController, PredictorFigures
from hil.configuration.speed_controller_file import CurrentLoop, MadeFor
from hil.configuration.toml_text import toml_text
from hil.studies.speed.analysis import finite
from hil.studies.speed.controller_text import plant_of, whole_us
from hil.studies.speed.losses import certified_of, loss_certificate, loss_figures

_DIGITS = 6
_US_PER_S = 1e6
_TORQUE_NOISE = 0.005
"""Of the rated torque: what a drive's torque differs from its demand within a period, ripple and offsets."""


@dataclass(frozen=True, slots=True)
class PredictorDrive:
    """What the design knows of the drive beside its motor."""

    current_bandwidth_hz: float
    encoder_counts: int
    speed_filter_hz: float
    inner_rate_hz: float
    """At which it takes the difference of its encoder's counts."""
    dead_time_s: float
    """From a command's instant to its voltage, and from a sample's to that of its count."""


@dataclass(frozen=True, slots=True)
class PredictorNetwork:
    """What the network does."""

    period_s: float
    delay_max_s: float
    """From a sample to its command's instant."""
    losses_max: int
    measured: bool
    """Whether somebody measured it: then a run is held against it."""


@dataclass(frozen=True, slots=True, eq=False)
class PredictorResult:
    """A predictor and what is known of it."""

    drive: PredictorDrive
    network: PredictorNetwork
    design: PredictorDesign
    robustness: PredictorRobustness
    losses: Sequence[SampledAnalysis] = ()
    """With ever fewer in a row, up to the most that are certified; empty: not looked at."""

    @property
    def figures(self) -> dict[str, Any]:
        """For JSON."""
        request, found = self.design.request, self.robustness
        return {
            "feasible": True,
            "structure": "predictor",
            "current_bandwidth_hz": self.drive.current_bandwidth_hz,
            "period_s": self.network.period_s,
            "delay_s": self.network.period_s + self.network.delay_max_s,
            "dead_time_s": self.drive.dead_time_s,
            "speed_noise_rad_s": request.speed_noise_rad_s,
            "speed_gain_nm_s_rad": float(self.design.F[1]),
            "torque_gain": float(self.design.F[0]),
            "load_noise_nm_sqrt_s": self.design.walks.quiet,
            "load_noise_max_nm_sqrt_s": self.design.walks.bold,
            "load_nm": request.load_nm,
            "peak_floor_rad_s": request.floor_rad_s(),
            "gamma": finite(found.gain),
            "certificate": {
                "gamma": "exact, of the sampled loop with constant gains and every sample",
                "losses": loss_figures(self.losses),
                "peaks": "none: by trial",
            },
            "robustness": self._robustness(),
        }

    def _robustness(self) -> dict[str, Any]:
        found = self.robustness
        return {
            "peak_over_floor": found.peak_over_floor,
            "peak_over_floor_inertia_70_percent": found.peak_over_floor_inertia_less,
            "peak_over_floor_inertia_130_percent": found.peak_over_floor_inertia_more,
            f"peak_over_floor_{LOST}_lost": found.peak_over_floor_lost,
            "gain_margin_db": finite(found.margins.gain_margin_db),
            "phase_margin_deg": finite(found.margins.phase_margin_deg),
            "modulus_margin": finite(found.margins.modulus_margin),
            "delay_margin_s": found.delay_margin_s,
            "inertia_70_percent": {"gamma_exact": finite(found.gain_inertia_less)},
            "inertia_130_percent": {"gamma_exact": finite(found.gain_inertia_more)},
            "current_bandwidth_50_percent": {"gamma_exact": finite(found.gain_current_loop_slower)},
            "gains_found_by_losses": [finite(gain) for gain in found.gains_found],
            "torque_noise_nm": finite(found.command_noise_nm),
        }


def design_speed_predictor(
    motor: PmsmParameters,
    drive: PredictorDrive,
    network: PredictorNetwork,
    load_nm: float,
    command_noise_nm: float,
) -> PredictorResult:
    """The design. Raises InfeasibleDesign."""
    found = as_written(design_predictor(request_of(motor, drive, network, load_nm, command_noise_nm)))
    return PredictorResult(drive, network, found, predictor_robustness(found, network.losses_max))


def as_written(design: PredictorDesign) -> PredictorDesign:
    """With the digits of its file: what is proved of a design is proved of the controller that runs."""
    walks = Walks(short(design.walks.quiet), short(design.walks.bold))
    return replace(design, F=np.array([short(gain) for gain in design.F]), walks=walks)


def certified_predictor(result: PredictorResult) -> PredictorResult:
    """The same with what is certified over lost samples. Raises NoSolution."""
    losses = with_losses(partial(predictor_losses, result.design), result.network.losses_max)
    return replace(result, losses=losses)


def request_of(
    motor: PmsmParameters,
    drive: PredictorDrive,
    network: PredictorNetwork,
    load_nm: float,
    command_noise_nm: float,
) -> PredictorRequest:
    """What a design goes by."""
    return PredictorRequest(
        motor=motor,
        current_rate_rad_s=math.tau * drive.current_bandwidth_hz,
        speed_filter_hz=drive.speed_filter_hz,
        speed_noise_rad_s=short(
            encoder_noise_rad_s(drive.encoder_counts, drive.speed_filter_hz, drive.inner_rate_hz)
        ),
        torque_noise_nm=short(_TORQUE_NOISE * motor.rated_torque_nm),
        period_s=network.period_s,
        delay_s=network.delay_max_s + drive.dead_time_s,
        load_nm=load_nm,
        command_noise_nm=command_noise_nm,
    )


def controller_of(result: PredictorResult) -> PredictorController:
    """The table [controller] of a design."""
    request, design, found = result.design.request, result.design, result.robustness
    motor = request.motor
    return PredictorController(
        kind="predictor",
        inertia_kg_m2=motor.inertia_kg_m2,
        viscous_friction_nm_s=motor.viscous_friction_nm_s,
        current_bandwidth_hz=result.drive.current_bandwidth_hz,
        speed_filter_hz=result.drive.speed_filter_hz,
        dead_time_us=short(result.drive.dead_time_s * _US_PER_S),
        speed_noise_rad_s=request.speed_noise_rad_s,
        torque_noise_nm=request.torque_noise_nm,
        load_noise_nm_sqrt_s=design.walks.quiet,
        load_noise_max_nm_sqrt_s=design.walks.bold,
        speed_gain_nm_s_rad=float(design.F[1]),
        torque_gain=float(design.F[0]),
        made_for=made_for_of(
            result.drive, result.network, motor, result.robustness.bandwidths, result.losses
        ),
        certificate=loss_certificate(result.losses),
        figures=PredictorFigures(
            load_nm=request.load_nm,
            peak_over_floor=short(found.peak_over_floor),
            peak_over_floor_inertia_70_percent=short(found.peak_over_floor_inertia_less),
            peak_over_floor_inertia_130_percent=short(found.peak_over_floor_inertia_more),
            gamma=short(found.gain),
            delay_margin_us=short(found.delay_margin_s * _US_PER_S),
            torque_noise_nm=short(found.command_noise_nm),
        ),
    )


def made_for_of(
    drive: PredictorDrive,
    network: PredictorNetwork,
    motor: PmsmParameters,
    bandwidths: tuple[float, float],
    losses: Sequence[SampledAnalysis],
) -> MadeFor:
    """``bandwidths``: shares of the current loop's own, between which the loop is stable.

    With a certificate it is made for as many losses in a row as that covers.
    """
    (least, most), hz = bandwidths, drive.current_bandwidth_hz
    made = MadeFor(
        delay_us=whole_us(network.period_s + network.delay_max_s),
        period_us=whole_us(network.period_s),
        plant=plant_of(motor),
        current_loop=CurrentLoop(
            bandwidth_hz=hz, bandwidth_min_hz=short(hz * least), bandwidth_max_hz=short(hz * most)
        ),
    )
    certified = certified_of(losses)
    if certified is None and not network.measured:
        return made
    held = {
        "losses_in_a_row_max": network.losses_max if certified is None else certified.network.losses_max,
        "delay_max_us": math.floor(network.delay_max_s * _US_PER_S + 1e-6),
    }
    return made.model_copy(update=held)


def write_predictor(path: Path, result: PredictorResult) -> None:
    """Write the file that a bench names as ``controller``. Raises BadInput if it cannot be written."""
    write_section(path, controller_of(result))


def write_section(path: Path, controller: Section) -> None:
    """Write a table [controller]. Raises BadInput if it cannot be written."""
    text = toml_text({"controller": controller.model_dump(mode="json", exclude_none=True)})
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BadInput("--out", "", str(path), "a file that can be written", str(error)) from None


def short(value: float) -> float:
    """With six digits, for a file."""
    return float(f"{value:.{_DIGITS}g}")
