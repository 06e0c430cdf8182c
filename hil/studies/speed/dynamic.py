"""``hil design speed --structure predictor`` and ``hinf``: controllers with their own states."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from servobench.design.delay.lmi import SOLVER
from servobench.design.errors import NoSolution
from servobench.design.motor import PmsmParameters
from servobench.design.sampled.analysis import SampledAnalysis
from servobench.design.sampled.loss_peak import losses_peak
from servobench.design.sampled.peak_steps import PeakBound
from servobench.design.speed.fused_design import FusedDesign
from servobench.design.speed.hinf_design import HinfDesign, design_hinf, hinf_robustness, uncertainty_norm
from servobench.design.speed.loss_certificate import (
    filter_gains,
    hinf_losses,
    predictor_losses,
    with_losses,
)
from servobench.design.speed.predictor_design import (
    PredictorDesign,
    PredictorRequest,
    design_predictor,
    losses_gain,
    predictor_robustness,
)
from servobench.design.speed.predictor_loop import PredictorLoop, Walks
from servobench.design.speed.predictor_peaks import predictor_peak
from servobench.design.speed.predictor_plant import encoder_noise_rad_s
from servobench.design.speed.random_loops import RandomHinf
from servobench.design.speed.speed_robustness import LoopRobustness
from servobench.drivers.timebase import US_PER_S
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.controller_files import (
    CurrentLoop,
    LoopFigures,
    LossCertificate,
    MadeFor,
)
from servobench.hil.configuration.controller_kinds import HinfSection
from servobench.hil.configuration.predicting_controllers import PredictorController
from servobench.hil.studies.numbers import finite, margin_figures, short
from servobench.hil.studies.speed.controller_text import begun_us, plant_of, sequence_proof, whole_us

ENCODER_COUNTS = 65_536
SPEED_FILTER_HZ = 500.0
"""Both belong to the simulated drive, the default for unknown drives."""
DEAD_TIME_US = 100.0
"""Dead time of the simulated drive: one and a half ticks of 62.5 us from a command to its voltage."""
INNER_RATE_HZ = 16_000.0
"""At which a drive takes the difference of its encoder's counts."""
_TORQUE_NOISE = 0.005
"""Share of the rated torque: difference between a drive's torque and its demand within a period, ripple and
offsets."""
_COVERS = "samples lost, at the delay and with the plant of the design, every command arriving"


def request_of(
    motor: PmsmParameters,
    current_bandwidth_hz: float,
    period_s: float,
    delay_max_s: float,
    load_nm: float,
    command_noise_nm: float,
    *,
    encoder_counts: int = ENCODER_COUNTS,
    speed_filter_hz: float = SPEED_FILTER_HZ,
    dead_time_us: float = DEAD_TIME_US,
    uneven_s: float = 0.0,
) -> PredictorRequest:
    """Return the request of a design, with the noise of the encoder and of the torque worked out."""
    noise_rad_s = encoder_noise_rad_s(encoder_counts, speed_filter_hz, INNER_RATE_HZ)
    return PredictorRequest(
        motor,
        current_bandwidth_hz,
        speed_filter_hz,
        short(noise_rad_s),
        short(_TORQUE_NOISE * motor.rated_torque_nm),
        period_s,
        delay_max_s,
        load_nm,
        command_noise_nm,
        1e-6 * dead_time_us,
        uneven_s,
    )


def certified_of(attempts: Sequence[SampledAnalysis]) -> SampledAnalysis | None:
    """Return the one with most consecutive losses; ``attempts``: of ever fewer, up to the first certified."""
    return attempts[-1] if attempts and attempts[-1].certified else None


def loss_figures(attempts: Sequence[SampledAnalysis], load_nm: float) -> dict[str, Any]:
    """Return figures for JSON; peaks after a load step of ``load_nm``."""
    certified = certified_of(attempts)
    missed = {
        f"{each.network.losses_max}_in_a_row": each.without_certificate
        for each in attempts
        if not each.certified
    }

    def scaled(peak: float | None) -> float | None:
        return None if peak is None else finite(load_nm * peak)

    figures: dict[str, Any] = {"covers": _COVERS} | ({"not_certified": missed} if missed else {})
    if certified is None:
        return figures | {"losses_in_a_row": None}
    return figures | {
        "losses_in_a_row": certified.network.losses_max,
        "gain_certified": certified.gain_certified,
        "gain_found": certified.gain_found,
        "decay_certified_per_s": certified.decay_certified_per_s,
        "decay_found_per_s": certified.decay_found_per_s,
        "peak_certified_rad_s": scaled(certified.peak_certified),
        "peak_found_rad_s": scaled(certified.peak_found),
    }


def loss_certificate(attempts: Sequence[SampledAnalysis], **premises: Any) -> LossCertificate | None:
    """Return the table of a controller file. ``premises``: of the proof, beyond the file's other keys."""
    certified = certified_of(attempts)
    sequences = None if certified is None else sequence_proof(certified)
    if certified is None or sequences is None:
        return None
    return LossCertificate(
        losses_in_a_row_max=certified.network.losses_max, solver=SOLVER, sequences=sequences, **premises
    )


@dataclass(frozen=True, slots=True, eq=False)
class DynamicResult(ABC):
    """A controller and its figures; each structure is a subclass, with its design."""

    structure: ClassVar[str]
    proved: ClassVar[dict[str, str]]
    """Meaning of ``gamma`` and other own figures, in words."""
    of_peaks: ClassVar = "over lost samples; over the floor by trial"
    """Knowledge of peaks."""

    design: PredictorDesign | FusedDesign | HinfDesign
    loop: LoopRobustness
    losses_max: int
    """Samples lost in a row."""
    measured: bool = False
    """True if the network was measured: a run is then compared with it."""
    losses: Sequence[SampledAnalysis] = field(default=(), kw_only=True)
    """Analyses with ever fewer consecutive losses, up to the most that are certified; empty: not done."""

    @abstractmethod
    def own_figures(self) -> dict[str, Any]:
        """Return the controller's own figures for JSON."""

    @abstractmethod
    def own_robustness(self) -> dict[str, Any]:
        """Return figures for JSON, in addition to those of every structure."""

    @abstractmethod
    def analysed(self, losses_max: int) -> SampledAnalysis:
        """Analyse every sequence with at most so many samples lost in a row. Raises NoSolution."""

    @abstractmethod
    def peak(self, readings_max: int, commands_max: int) -> PeakBound:
        """Return the largest error after a load step of 1 N m, with at most so many readings and commands
        lost in a row. Raises NoSolution."""

    @abstractmethod
    def premises(self) -> dict[str, Any]:
        """Return the keys of the certificate that the proof rests on, beyond those of the controller."""

    @abstractmethod
    def controller(self) -> Section:
        """Return the table [controller]."""

    def certified(self) -> Self:
        """Add the certificate over lost samples. Raises NoSolution."""
        *others, last = with_losses(self.analysed, self.losses_max)
        if last.certified and not self.design.request.uneven_s:  # peaks are of even periods
            with suppress(NoSolution):
                peak = self.peak(last.network.losses_max, 0)
                last = replace(last, peak_found=peak.reached, peak_certified=peak.certified)
        return replace(self, losses=[*others, last])

    @property
    def figures(self) -> dict[str, Any]:
        """For JSON."""
        request = self.design.request
        return {
            "feasible": True,
            "structure": self.structure,
            "current_bandwidth_hz": request.current_bandwidth_hz,
            "period_s": request.period_s,
            "delay_s": request.period_s + request.delay_max_s,
            "dead_time_s": request.dead_time_s,
            "speed_noise_rad_s": request.speed_noise_rad_s,
            **self.own_figures(),
            "load_nm": request.load_nm,
            "peak_floor_rad_s": request.floor_rad_s(),
            "gamma": finite(self.loop.gain),
            "certificate": {
                **self.proved,
                "losses": loss_figures(self.losses, request.load_nm),
                "peaks": self.of_peaks,
            },
            "robustness": {
                **self.loop.peaks_over_floor,
                **margin_figures(self.loop.margins),
                "delay_margin_s": self.loop.delay_margin_s,
                **{name: {"gamma_exact": finite(gain)} for name, gain in self.loop.gains.items()},
                **self.own_robustness(),
                "torque_noise_nm": finite(self.loop.command_noise_nm),
            },
        }

    def told(self, norm: float | None = None) -> dict[str, Any]:
        """Return the part of the table [controller] about design and quality, common to every structure."""
        request, loop = self.design.request, self.loop
        peaks = {
            name: short(peak)
            for name, peak in loop.peaks_over_floor.items()
            if name in LoopFigures.model_fields
        }
        return {
            "inertia_kg_m2": request.motor.inertia_kg_m2,
            "viscous_friction_nm_s": request.motor.viscous_friction_nm_s,
            "made_for": self._made_for(),
            "certificate": loss_certificate(self.losses, **self.premises()),
            "figures": LoopFigures(
                load_nm=request.load_nm,
                norm=norm,
                gamma=short(loop.gain),
                delay_margin_us=short(loop.delay_margin_s * US_PER_S),
                torque_noise_nm=short(loop.command_noise_nm),
                **peaks,
            ),
        }

    def _made_for(self) -> MadeFor:
        """Return made_for; with a certificate, for as many consecutive losses as that covers."""
        request, (least, most) = self.design.request, self.loop.bandwidths
        hz = request.current_bandwidth_hz
        certified = certified_of(self.losses)
        held: dict[str, Any] = {}
        if certified is not None or self.measured:
            held = {
                "losses_in_a_row_max": self.losses_max if certified is None else certified.network.losses_max,
                "delay_max_us": begun_us(request.delay_max_s),
                "sync_within_us": begun_us(request.uneven_s) or None,
            }
        return MadeFor(
            delay_us=whole_us(request.period_s + request.delay_max_s),
            period_us=whole_us(request.period_s),
            plant=plant_of(request.motor),
            current_loop=CurrentLoop(
                bandwidth_hz=hz, bandwidth_min_hz=short(hz * least), bandwidth_max_hz=short(hz * most)
            ),
            **held,
        )


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

    def peak(self, readings_max: int, commands_max: int) -> PeakBound:
        return losses_peak(RandomHinf(self.design.loop()), readings_max, commands_max)

    def premises(self) -> dict[str, Any]:
        request = self.design.request
        return {
            "speed_filter_hz": request.speed_filter_hz,
            "dead_time_us": short(request.dead_time_s * US_PER_S),
        }

    def controller(self) -> HinfSection:
        """Return the controller; the matrices keep all their digits, as they integrate exactly."""
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
    """Design it. Raises InfeasibleDesign."""
    design = design_hinf(request)
    return HinfResult(design, hinf_robustness(design), losses_max, measured)


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

    def peak(self, readings_max: int, commands_max: int) -> PeakBound:
        made = self.design
        loop = PredictorLoop(made.prediction)
        return predictor_peak(loop, made.request.kalman, made.walks, readings_max, commands_max)

    def premises(self) -> dict[str, Any]:
        certified = certified_of(self.losses)
        if certified is None:
            return {}
        boxes = filter_gains(self.design, certified.network.losses_max)
        return {"filter_gains": [[corner[1:].tolist() for corner in corners] for corners in boxes]}

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
    """Design it with the digits of its file: the proofs hold for the controller that runs.

    Raises InfeasibleDesign.
    """
    design = design_predictor(request)
    walks = Walks(short(design.walks.quiet), short(design.walks.bold))
    design = replace(design, F=np.array([short(gain) for gain in design.F]), walks=walks)
    return PredictorResult(design, predictor_robustness(design), losses_max, measured)
