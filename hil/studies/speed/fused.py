"""``hil design speed --structure fused``: the predictor on count and speed of one SYNC."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from servobench.design.sampled.analysis import SampledAnalysis
from servobench.design.sampled.loss_peak import losses_peak
from servobench.design.sampled.peak_steps import PeakBound
from servobench.design.speed.fused_design import (
    FusedDesign,
    FusedRequest,
    design_fused,
    fused_losses,
    fused_robustness,
    rounding,
)
from servobench.design.speed.predictor_design import PredictorRequest
from servobench.design.speed.random_loops import RandomFused
from servobench.drivers.timebase import US_PER_S
from servobench.hil.configuration.predicting_controllers import FusedController
from servobench.hil.studies.numbers import short
from servobench.hil.studies.speed.dynamic import ENCODER_COUNTS, INNER_RATE_HZ, DynamicResult


def fused_request(
    known: PredictorRequest, encoder_counts: int = ENCODER_COUNTS, sampling_jitter_us: float = 0.0
) -> FusedRequest:
    """Return the request of a design. ``sampling_jitter_us``: rms by which the instant of a sample is unsure;
    it counts at the rated speed."""
    jitter_rad = 1e-6 * sampling_jitter_us * known.motor.rated_speed_rad_s
    noise = rounding(encoder_counts, known.speed_filter_hz, INNER_RATE_HZ, jitter_rad)
    return FusedRequest(known, tuple(map(tuple, noise.tolist())))


@dataclass(frozen=True, slots=True, eq=False)
class FusedResult(DynamicResult):
    """A Kalman filter with constant gains, a prediction over the delay, and a feedback."""

    structure: ClassVar = "fused"
    proved: ClassVar = {"gamma": "exact, of the sampled loop with every sample"}
    of_peaks: ClassVar = "over lost samples; over the floor exact for the instants tried, without noise"

    design: FusedDesign

    def own_figures(self) -> dict[str, Any]:
        return {
            "speed_gain_nm_s_rad": float(self.design.F[1]),
            "torque_gain": float(self.design.F[0]),
            "count_spread_rad": short(self.design.spread_rad),
        }

    def own_robustness(self) -> dict[str, Any]:
        return {}

    def analysed(self, losses_max: int) -> SampledAnalysis:
        return fused_losses(self.design, losses_max)

    def peak(self, readings_max: int, commands_max: int) -> PeakBound:
        remembering = RandomFused(self.design.loop(), self.design.gains)
        return losses_peak(remembering, readings_max, commands_max)

    def premises(self) -> dict[str, Any]:
        return {}

    def controller(self) -> FusedController:
        request = self.design.request
        gains: dict[str, Any] = {
            "gains": [L.tolist() for L in self.design.gains],
            "speed_gains": list(map(short, self.design.speed_gains())),
        }
        return FusedController(
            kind="fused",
            period_us=round(request.period_s * US_PER_S),
            current_bandwidth_hz=request.current_bandwidth_hz,
            speed_filter_hz=request.speed_filter_hz,
            dead_time_us=short(request.dead_time_s * US_PER_S),
            tick_us=short(US_PER_S / INNER_RATE_HZ),
            **gains,
            **self.own_figures(),
            **self.told(),
        )


def design_speed_fused(asked: FusedRequest, losses_max: int, measured: bool = False) -> FusedResult:
    """Design it with the digits of its file: the proofs hold for the controller that runs.

    Raises InfeasibleDesign.
    """
    design = design_fused(asked)
    gains = [np.array([[short(entry) for entry in row] for row in L]) for L in design.gains]
    design = replace(design, F=np.array([short(gain) for gain in design.F]), gains=gains)
    return FusedResult(design, fused_robustness(design), losses_max, measured)
