"""``hil design speed --structure hinf``."""

from dataclasses import dataclass
from typing import Any, ClassVar

from design.sampled.analysis import SampledAnalysis
from design.speed.hinf_design import HinfDesign, design_hinf, hinf_robustness, uncertainty_norm
from design.speed.loss_certificate import hinf_losses
from design.speed.predictor_design import PredictorRequest
from hil.configuration.hinf_section import HinfSection
from hil.studies.numbers import short
from hil.studies.speed.controller_text import US_PER_S
from hil.studies.speed.dynamic import DynamicResult


@dataclass(frozen=True, slots=True, eq=False)
class HinfResult(DynamicResult):
    """H-infinity output feedback on the speed error."""

    structure: ClassVar = "hinf"
    proved: ClassVar = {
        "norm": "of the weighted problem, with the controller of full order",
        "gamma": "exact, of the sampled loop with every sample",
    }

    design: HinfDesign

    def own_figures(self) -> dict[str, Any]:
        design = self.design
        return {
            "weights": {
                "error_s_rad": design.weights.error,
                "noise_rad_s": design.weights.noise_rad_s,
                "integral_rad_s": design.weights.integral_rad_s,
            },
            "norm": design.found.gamma,
            "norm_min": design.found.gamma_min,
            "order_full": design.found.K.order,
            "order": design.controller.order,
        }

    def own_robustness(self) -> dict[str, Any]:
        return {"uncertainty_norm": uncertainty_norm(self.design)}

    def analysed(self, losses_max: int) -> SampledAnalysis:
        return hinf_losses(self.design, losses_max)

    def controller(self) -> HinfSection:
        """The matrices keep all their digits: they integrate exactly."""
        request, c = self.design.request, self.design.controller
        lags_s = 1.0 / request.current_rate_rad_s + 1.0 / request.plant.filter_rate_rad_s
        return HinfSection(
            kind="hinf",
            period_us=round(request.period_s * US_PER_S),
            A=c.A.tolist(),
            B=c.B.tolist(),
            L=c.L.tolist(),
            C=c.C.tolist(),
            D=c.D,
            answer_us=short((request.delay_s + lags_s) * US_PER_S),
            **self.told(norm=short(self.design.found.gamma)),
        )


def design_speed_hinf(request: PredictorRequest, losses_max: int, measured: bool = False) -> HinfResult:
    """The design. Raises InfeasibleDesign."""
    design = design_hinf(request)
    return HinfResult(design, hinf_robustness(design), losses_max, measured)
