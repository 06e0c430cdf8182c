"""``hil design speed --structure predictor``."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from design.motor import PmsmParameters
from design.sampled.analysis import SampledAnalysis
from design.speed.loss_certificate import predictor_losses
from design.speed.predictor_design import (
    PredictorDesign,
    PredictorRequest,
    PredictorRobustness,
    design_predictor,
    predictor_robustness,
)
from design.speed.predictor_trial import Walks
from hil.configuration.predictor_section import PredictorController
from hil.studies.numbers import finite, short
from hil.studies.speed.dynamic import (
    US_PER_S,
    DynamicResult,
    PredictorDrive,
    PredictorNetwork,
    request_of,
)


@dataclass(frozen=True, slots=True, eq=False)
class PredictorResult(DynamicResult):
    """A Kalman filter, a prediction over the delay, and a feedback."""

    structure: ClassVar = "predictor"
    proved: ClassVar = {"gamma": "exact, of the sampled loop with constant gains and every sample"}

    design: PredictorDesign
    robustness: PredictorRobustness

    @property
    def request(self) -> PredictorRequest:
        return self.design.request

    @property
    def loop(self) -> PredictorRobustness:
        return self.robustness

    def own_figures(self) -> dict[str, Any]:
        return {
            "speed_gain_nm_s_rad": float(self.design.F[1]),
            "torque_gain": float(self.design.F[0]),
            "load_noise_nm_sqrt_s": self.design.walks.quiet,
            "load_noise_max_nm_sqrt_s": self.design.walks.bold,
        }

    def own_robustness(self) -> dict[str, Any]:
        return {"gains_found_by_losses": [finite(gain) for gain in self.robustness.gains_found]}

    def analysed(self, losses_max: int) -> SampledAnalysis:
        return predictor_losses(self.design, losses_max)

    def controller(self) -> PredictorController:
        request, drive = self.request, self.drive
        return PredictorController(
            kind="predictor",
            current_bandwidth_hz=drive.current_bandwidth_hz,
            speed_filter_hz=drive.speed_filter_hz,
            dead_time_us=short(drive.dead_time_s * US_PER_S),
            speed_noise_rad_s=request.speed_noise_rad_s,
            torque_noise_nm=request.torque_noise_nm,
            **self.own_figures(),
            **self.told(),
        )


def design_speed_predictor(
    motor: PmsmParameters,
    drive: PredictorDrive,
    network: PredictorNetwork,
    load_nm: float,
    command_noise_nm: float,
) -> PredictorResult:
    """The design. Raises InfeasibleDesign."""
    design = as_written(design_predictor(request_of(motor, drive, network, load_nm, command_noise_nm)))
    return PredictorResult(drive, network, design, predictor_robustness(design, network.losses_max))


def as_written(design: PredictorDesign) -> PredictorDesign:
    """With the digits of its file: what is proved of a design is proved of the controller that runs."""
    walks = Walks(short(design.walks.quiet), short(design.walks.bold))
    return replace(design, F=np.array([short(gain) for gain in design.F]), walks=walks)
