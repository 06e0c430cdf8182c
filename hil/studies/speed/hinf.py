"""``hil design speed --structure hinf``: the design, its figures, and the controller file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from design.motor import PmsmParameters
from design.sampled.analysis import SampledAnalysis
from design.speed.hinf_design import LOST, HinfDesign, HinfRobustness, design_hinf, hinf_robustness
from design.speed.loss_certificate import hinf_losses, with_losses
from hil.configuration.hinf_section import HinfFigures, HinfSection
from hil.studies.speed.analysis import finite
from hil.studies.speed.losses import loss_certificate, loss_figures
from hil.studies.speed.predictor import (
    PredictorDrive,
    PredictorNetwork,
    made_for_of,
    request_of,
    short,
    write_section,
)

_US_PER_S = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class HinfResult:
    """A controller and what is known of it."""

    drive: PredictorDrive
    network: PredictorNetwork
    design: HinfDesign
    robustness: HinfRobustness
    losses: Sequence[SampledAnalysis] = ()
    """With ever fewer in a row, up to the most that are certified; empty: not looked at."""

    @property
    def figures(self) -> dict[str, Any]:
        """For JSON."""
        design, found = self.design, self.robustness
        request = design.request
        return {
            "feasible": True,
            "structure": "hinf",
            "current_bandwidth_hz": self.drive.current_bandwidth_hz,
            "period_s": self.network.period_s,
            "delay_s": self.network.period_s + self.network.delay_max_s,
            "dead_time_s": self.drive.dead_time_s,
            "speed_noise_rad_s": request.speed_noise_rad_s,
            "weights": {
                "error_s_rad": design.weights.error,
                "noise_rad_s": design.weights.noise_rad_s,
                "integral_rad_s": design.weights.integral_rad_s,
            },
            "norm": design.found.gamma,
            "norm_min": design.found.gamma_min,
            "order_full": design.found.K.order,
            "order": design.controller.order,
            "load_nm": request.load_nm,
            "peak_floor_rad_s": request.floor_rad_s(),
            "gamma": finite(found.gain),
            "certificate": {
                "norm": "of the weighted problem, with the controller of full order",
                "gamma": "exact, of the sampled loop with every sample",
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
            "uncertainty_norm": found.uncertainty_norm,
            "inertia_70_percent": {"gamma_exact": finite(found.gain_inertia_less)},
            "inertia_130_percent": {"gamma_exact": finite(found.gain_inertia_more)},
            "current_bandwidth_50_percent": {"gamma_exact": finite(found.gain_current_loop_slower)},
            "torque_noise_nm": finite(found.command_noise_nm),
        }


def design_speed_hinf(
    motor: PmsmParameters,
    drive: PredictorDrive,
    network: PredictorNetwork,
    load_nm: float,
    command_noise_nm: float,
) -> HinfResult:
    """The design. Raises InfeasibleDesign."""
    design = design_hinf(request_of(motor, drive, network, load_nm, command_noise_nm))
    return HinfResult(drive, network, design, hinf_robustness(design))


def certified_hinf(result: HinfResult) -> HinfResult:
    """The same with what is certified over lost samples. Raises NoSolution."""
    losses = with_losses(partial(hinf_losses, result.design), result.network.losses_max)
    return replace(result, losses=losses)


def hinf_controller_of(result: HinfResult) -> HinfSection:
    """The table [controller] of a design. The matrices keep all their digits: they integrate exactly."""
    design, found, c = result.design, result.robustness, result.design.controller
    request, motor = design.request, design.request.motor
    lags_s = 1.0 / request.current_rate_rad_s + 1.0 / request.plant.filter_rate_rad_s
    return HinfSection(
        kind="hinf",
        period_us=round(request.period_s * _US_PER_S),
        A=tuple(tuple(map(float, row)) for row in c.A),
        B=tuple(map(float, c.B)),
        L=tuple(map(float, c.L)),
        C=tuple(map(float, c.C)),
        D=c.D,
        inertia_kg_m2=motor.inertia_kg_m2,
        viscous_friction_nm_s=motor.viscous_friction_nm_s,
        answer_us=short((request.delay_s + lags_s) * _US_PER_S),
        made_for=made_for_of(result.drive, result.network, motor, found.bandwidths, result.losses),
        certificate=loss_certificate(result.losses),
        figures=HinfFigures(
            load_nm=request.load_nm,
            peak_over_floor=short(found.peak_over_floor),
            peak_over_floor_inertia_70_percent=short(found.peak_over_floor_inertia_less),
            peak_over_floor_inertia_130_percent=short(found.peak_over_floor_inertia_more),
            norm=short(design.found.gamma),
            gamma=short(found.gain),
            delay_margin_us=short(found.delay_margin_s * _US_PER_S),
            torque_noise_nm=short(found.command_noise_nm),
        ),
    )


def write_hinf(path: Path, result: HinfResult) -> None:
    """Write the file that a bench names as ``controller``. Raises BadInput if it cannot be written."""
    write_section(path, hinf_controller_of(result))
