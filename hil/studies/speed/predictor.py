"""``hil design speed --structure predictor``."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from design.sampled.analysis import SampledAnalysis
from design.speed.loss_certificate import predictor_losses
from design.speed.predictor_design import (
    PredictorDesign,
    PredictorRequest,
    design_predictor,
    losses_gain,
    predictor_robustness,
)
from design.speed.predictor_trial import Walks
from hil.configuration.predictor_section import PredictorController
from hil.studies.numbers import finite, short
from hil.studies.speed.controller_text import US_PER_S
from hil.studies.speed.dynamic import DynamicResult


@dataclass(frozen=True, slots=True, eq=False)
class PredictorResult(DynamicResult):
    """A Kalman filter, a prediction over the delay, and a feedback."""

    structure: ClassVar = "predictor"
    proved: ClassVar = {"gamma": "exact, of the sampled loop with constant gains and every sample"}

    design: PredictorDesign

    def own_figures(self) -> dict[str, Any]:
        return {
            "speed_gain_nm_s_rad": float(self.design.F[1]),
            "torque_gain": float(self.design.F[0]),
            "load_noise_nm_sqrt_s": self.design.walks.quiet,
            "load_noise_max_nm_sqrt_s": self.design.walks.bold,
        }

    def own_robustness(self) -> dict[str, Any]:
        gains = (losses_gain(self.design, [lost]) for lost in range(1, self.losses_max + 1))
        return {"gains_found_by_losses": list(map(finite, gains))}

    def analysed(self, losses_max: int) -> SampledAnalysis:
        return predictor_losses(self.design, losses_max)

    def controller(self) -> PredictorController:
        request = self.design.request
        return PredictorController(
            kind="predictor",
            current_bandwidth_hz=request.current_bandwidth_hz,
            speed_filter_hz=request.speed_filter_hz,
            dead_time_us=short(request.dead_time_s * US_PER_S),
            speed_noise_rad_s=request.speed_noise_rad_s,
            torque_noise_nm=request.torque_noise_nm,
            **self.own_figures(),
            **self.told(),
        )


def design_speed_predictor(
    request: PredictorRequest, losses_max: int, measured: bool = False
) -> PredictorResult:
    """The design, with the digits of its file: what is proved of it is proved of the controller that runs.

    Raises InfeasibleDesign.
    """
    design = design_predictor(request)
    walks = Walks(short(design.walks.quiet), short(design.walks.bold))
    design = replace(design, F=np.array([short(gain) for gain in design.F]), walks=walks)
    return PredictorResult(design, predictor_robustness(design), losses_max, measured)
