"""The design behind ``hil design speed``: the best speed feedback for a delay, a network, or a required
gain."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

from servobench.design.delay.certificate import CertifiedGain, certified_gain, certified_gain_auto
from servobench.design.delay.delay_loop import (
    Feedback,
    SpeedModel,
    current_rate_rad_s,
    peak_floor_rad_s,
    percent_of_speed,
    speed_model,
)
from servobench.design.delay.delay_norm import hinf_norm
from servobench.design.delay.lmi import SOLVED, SOLVER
from servobench.design.errors import DesignError, NoSolution
from servobench.design.motor import PmsmParameters
from servobench.design.sampled.analysis import SampledAnalysis, analyse_sampled, with_peak
from servobench.design.sampled.bandwidth_range import (
    BandwidthRange,
    bandwidth_range,
    constant_bandwidth_range,
)
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork
from servobench.design.speed.cone_complementarity import largest_ccl_delay
from servobench.design.speed.coupled_design import couplings_off, least_gain_over
from servobench.design.speed.lmi_design import largest_certified_delay, least_certified_gain
from servobench.design.speed.sampled_design import least_sampled_gain
from servobench.design.speed.speed_design import SpeedDesign, largest_delay, least_gain
from servobench.design.speed.speed_robustness import speed_robustness
from servobench.hil.studies.numbers import finite, margin_figures
from servobench.hil.studies.speed.analysis import network_figures, sequence_figures

_CCL_BISECTIONS = 12
"""The first is at the upper end; eleven halvings leave 1/4096 of the least certified gain."""
_CCL_SPAN = 1.5
"""Multiple of the least certified gain at which the bisection for Algorithm 4.2 begins."""
_NO_DELAY_S = 1e-6
"""Practically none for a sampled loop; without any the least gain is not attained."""
_KEPT = 1.0 + 1e-6
"""Share of the wanted gain that still counts as keeping it."""


@dataclass(frozen=True, slots=True)
class Way:
    """Method of finding a feedback."""

    method: str
    """exact, lmi or ccl."""
    feedback: Feedback
    integral: bool
    integral_time_s: float | None
    """K2/K3; None: in proportion to the delay."""
    for_sampled: bool
    """True: the loop over the network itself is optimised, not the one with the constant delay."""


@dataclass(frozen=True, slots=True)
class DesignRequest:
    """Given and wanted values; ``gamma`` or the delay may be open, not both."""

    motor: PmsmParameters
    gamma: float | None
    """Wanted gain from load torque to speed error, rad/s per N m; None: the least."""
    delay_s: float | None
    """The constant delay; None: the largest."""
    network: SampledNetwork | None
    """The network behind the delay, for the figures of the sampled loop."""
    way: Way
    load_nm: float
    speed_rad_s: float
    """For figures in percent."""
    current_bandwidth_hz: float | None
    """Bandwidth of the drive's current loop; None: the winding's own, R/L, as in [Ling2012]."""

    def percent(self, gain: float) -> float:
        """Return the share of the speed, %, for a gain in rad/s per N m under the load."""
        return percent_of_speed(gain, self.load_nm, self.speed_rad_s)


@dataclass(frozen=True, slots=True, eq=False)
class DesignResult:
    """A feedback and its proofs."""

    request: DesignRequest
    design: SpeedDesign
    """With the gain that the method guarantees at the delay; of the sampled loop, if that was optimised."""
    gamma_exact: float
    """Gain of the loop with the constant delay; inf: unstable, though the sampled loop may not be."""
    certified: CertifiedGain | None
    """Certificate of the loop with the constant delay; None if the sampled loop was optimised."""
    sampled: SampledAnalysis | None
    bandwidths: BandwidthRange | None = None
    """Bandwidths of the current loop covered by the certificates: those of the sampled loop, if there is one;
    None: not computed."""

    @property
    def gains(self) -> list[float]:
        """What is fed back: nothing behind a coupling."""
        fed = [float(entry) for entry in self.design.K]
        return fed[: 3 if self.request.way.integral else 2]

    @property
    def figures(self) -> dict[str, Any]:
        """For JSON."""
        request, design = self.request, self.design
        floor = peak_floor_rad_s(request.motor, design.delay_s)
        figures: dict[str, Any] = {
            "feasible": True,
            "gain": self.gains,
            "current_bandwidth_hz": request.current_bandwidth_hz,
            "gamma": design.gain,
            "delay_s": design.delay_s,
            "method": request.way.method,
            "feedback": request.way.feedback.value,
            "integral": request.way.integral,
            "target": "sampled" if request.way.for_sampled else "constant",
            "certificate": self.certificate(),
            "gamma_exact": finite(self.gamma_exact),
            "error_percent": request.percent(design.gain),
            "load_nm": request.load_nm,
            "speed_rad_s": request.speed_rad_s,
            "peak_floor_percent": request.percent(floor),
        }
        if self.sampled is not None and request.network is not None:
            share = 100.0 * request.load_nm / request.speed_rad_s
            figures["sampled"] = network_figures(request.network) | sequence_figures(self.sampled, share)
        if self.bandwidths is not None:
            figures["current_bandwidths"] = asdict(self.bandwidths)
        figures["robustness"] = _robustness(self)
        return figures

    def certificate(self) -> dict[str, Any]:
        """Return the certificate of the loop with the constant delay, for JSON and file."""
        if self.certified is None:
            assert self.sampled is not None
            return {"solver": SOLVER, "status": "see sampled"}
        return {
            "gamma": self.certified.gain,
            "order": self.certified.order,
            "solver": SOLVER,
            "status": SOLVED,
            "min_margin": self.certified.min_margin,
        }


def _robustness(result: DesignResult) -> dict[str, Any]:
    """Return the robustness for JSON."""
    request, design, sampled = result.request, result.design, result.sampled

    def plant(motor: PmsmParameters, share: float) -> SpeedModel:
        rate = current_rate_rad_s(request.motor, request.current_bandwidth_hz) * share
        return speed_model(motor, request.way.integral, rate / math.tau)

    model = plant(request.motor, 1.0)
    coupled = couplings_off(request.motor)
    held = None if request.network is None else HeldLoop(model, design.K, request.network)
    loop = model.loop(design.K, design.delay_s)
    robustness = speed_robustness(plant, request.motor, loop, held, sampled.patterns if sampled else [])

    return {
        "peak_over_floor": finite(robustness.peak_over_floor),
        **margin_figures(robustness.margins),
        "delay_margin_s": finite(robustness.delay_margin_s),
        **{
            name: {"gamma_exact": finite(plant.gain), "gain_found": finite(plant.gain_found)}
            for name, plant in robustness.changed.items()
        },
        **{
            name: {"gamma_exact": finite(hinf_norm(plant(motor, 1.0).loop(design.K, design.delay_s)))}
            for name, motor in coupled.items()
        },
        "noise_to_torque_nm_s_rad": finite(robustness.noise_nm_s_rad),
    }


def with_bandwidths(result: DesignResult) -> DesignResult:
    """Add the range of current bandwidths that its certificates cover."""
    request, design, sampled = result.request, result.design, result.sampled
    bandwidth_hz = request.current_bandwidth_hz
    if bandwidth_hz is None or (sampled is not None and sampled.network.uneven_s):
        return result  # ranges are of even periods

    def model_at(hz: float) -> SpeedModel:
        return speed_model(request.motor, request.way.integral, hz)

    if sampled is None:
        assert result.certified is not None
        nominal = BandwidthRange(bandwidth_hz, bandwidth_hz, result.certified.gain)
        bandwidths = constant_bandwidth_range(model_at, design.K, design.delay_s, nominal)
    elif sampled.gain_certified is None or sampled.decay_certified_per_s is None:
        return result
    else:
        nominal = BandwidthRange(
            bandwidth_hz, bandwidth_hz, sampled.gain_certified, sampled.decay_certified_per_s
        )
        bandwidths = bandwidth_range(model_at, design.K, sampled.network, sampled.patterns, nominal)
    return replace(result, bandwidths=bandwidths)


@dataclass(eq=False)
class Unreachable(DesignError):
    """The required gain is beyond the best one's reach at the delay; with the changes that would help."""

    request: DesignRequest
    best: SpeedDesign
    delay_needed_s: float | None
    """Delay at which the required gain could just be kept; None if none was found."""

    @property
    def figures(self) -> dict[str, Any]:
        """Return for JSON: the demand, the best possible, and each single change that would suffice."""
        request, best = self.request, self.best
        gamma = request.gamma or math.nan
        return {
            "feasible": False,
            "method": request.way.method,
            "demand": {
                "gamma": gamma,
                "delay_s": best.delay_s,
                "error_percent": request.percent(gamma),
            },
            "best": {
                "gain": best.K.tolist()[: 3 if request.way.integral else 2],
                "gamma": best.gain,
                "delay_s": best.delay_s,
                "error_percent": request.percent(best.gain),
            },
            "would_do": {
                "load_nm": request.load_nm * gamma / best.gain,
                "delay_s": self.delay_needed_s,
                **self._network_changes(),
            },
        }

    def _network_changes(self) -> dict[str, Any]:
        network, needed_s = self.request.network, self.delay_needed_s
        if network is None or needed_s is None:
            return {}
        room_s = needed_s - network.delay_max_s
        period_s = room_s / (network.losses_max + 1)
        losses = math.floor(room_s / network.period_s * (1.0 + 1e-9)) - 1
        return {
            "period_s": period_s if period_s > 0.0 else None,
            "loss_max": losses if losses >= 0 else None,
        }

    def __str__(self) -> str:
        request, figures = self.request, self.figures
        demand, best, do = figures["demand"], figures["best"], figures["would_do"]
        ways = [f"a load step of at most {do['load_nm']:.4g} N m instead of {request.load_nm:g}"]
        if do["delay_s"] is not None:
            ways.append(f"a delay of at most {1e3 * do['delay_s']:.4g} ms")
        if do.get("period_s") is not None:
            ways.append(f"a period of at most {1e3 * do['period_s']:.4g} ms with the same losses")
        if do.get("loss_max") is not None:
            ways.append(f"at most {do['loss_max']} losses in a row at the same period")
        if request.network is not None and not request.way.for_sampled:
            ways.append("perhaps --target sampled, which makes the loop best that really runs")
        return (
            f"{_amount(demand)} is out of reach at a delay of {1e3 * self.best.delay_s:.4g} ms by the method "
            f"{request.way.method}; the best is {_amount(best)}; what would do: {', or '.join(ways)}"
        )


def _amount(figures: dict[str, Any]) -> str:
    return f"{figures['error_percent']:.4g} % of the speed ({figures['gamma']:.5g} rad/s per N m)"


def design_speed(request: DesignRequest, tell: Callable[[str], None] = lambda _: None) -> DesignResult:
    """Design the feedback; ``tell`` is called with a line before each step that may take long.

    Raises Unreachable, or NoSolution if the method ends without an answer.
    """
    model = speed_model(request.motor, request.way.integral, request.current_bandwidth_hz)
    if request.network is not None:
        tell("gain and decay over every sequence of losses and delays: some 10 s")
    result = _for_sampled(model, request) if request.way.for_sampled else _for_constant(model, request)
    if result.sampled is None:
        return result
    tell("largest error after a load step over every sequence: up to two minutes")
    return replace(result, sampled=with_peak(result.sampled))


def _for_constant(model: SpeedModel, request: DesignRequest) -> DesignResult:
    if request.delay_s is None:
        assert request.gamma is not None
        try:
            design = _largest(model, request, request.gamma)
        except NoSolution:
            # not even without delay: what can be had there is the answer
            raise Unreachable(request, _least(model, request, _NO_DELAY_S), None) from None
    else:
        design = _least(model, request, request.delay_s)
        if request.gamma is not None and design.gain > request.gamma * _KEPT:
            raise Unreachable(request, design, _needed(model, request))
    loop = model.loop(design.K, design.delay_s)
    exact = request.way.method == "exact"
    certified = certified_gain_auto(model, loop) if exact else certified_gain(model, loop, 0)
    sampled = analyse_sampled(model, design.K, request.network) if request.network else None
    if request.gamma is not None and sampled is not None:
        _demand_sampled(request, replace(design, gain=_certified(sampled)))
    return DesignResult(request, design, hinf_norm(loop), certified, sampled)


def _for_sampled(model: SpeedModel, request: DesignRequest) -> DesignResult:
    assert request.network is not None
    best = least_sampled_gain(model, request.network, request.way.feedback, request.way.integral_time_s)
    sampled = analyse_sampled(model, best.K, request.network)
    design = replace(best, gain=_certified(sampled))
    _demand_sampled(request, design)
    return DesignResult(request, design, hinf_norm(model.loop(best.K, best.delay_s)), None, sampled)


def _certified(sampled: SampledAnalysis) -> float:
    """Return the gain of the loop as it runs, under every sequence. Raises NoSolution."""
    if sampled.gain_certified is None:
        raise NoSolution("the loop that runs cannot be certified", sampled.without_certificate)
    return sampled.gain_certified


def _demand_sampled(request: DesignRequest, design: SpeedDesign) -> None:
    """Require the loop as it runs to keep the gain too, under every sequence. Raises Unreachable."""
    if request.gamma is not None and design.gain > request.gamma * _KEPT:
        raise Unreachable(request, design, None)


def _largest(model: SpeedModel, request: DesignRequest, gamma: float) -> SpeedDesign:
    if request.way.method == "exact":
        return largest_delay(model, gamma, request.way.feedback, request.way.integral_time_s)
    if request.way.method == "lmi":
        return largest_certified_delay(model, gamma, request.way.feedback)
    return largest_ccl_delay(model, gamma)


def _least(model: SpeedModel, request: DesignRequest, delay_s: float) -> SpeedDesign:
    if request.way.method == "exact" and model.rigid is not None:
        way, hz = request.way, request.current_bandwidth_hz
        motors = (request.motor, *couplings_off(request.motor).values())
        models = [speed_model(motor, way.integral, hz) for motor in motors]
        return least_gain_over(models, delay_s, way.feedback, way.integral_time_s)
    if request.way.method == "exact":
        return least_gain(model, delay_s, request.way.feedback, request.way.integral_time_s)
    certified = least_certified_gain(model, delay_s, request.way.feedback)
    return certified if request.way.method == "lmi" else _least_by_ccl(model, delay_s, certified.gain)


def _least_by_ccl(model: SpeedModel, delay_s: float, certified: float) -> SpeedDesign:
    """Apply Algorithm 4.2 to the delay: bisection over gamma, which lies above the least ``certified``."""
    low, high = certified, certified * _CCL_SPAN
    best: SpeedDesign | None = None
    for _ in range(_CCL_BISECTIONS):
        gamma = high if best is None else 0.5 * (low + high)
        try:
            largest = largest_ccl_delay(model, gamma)
        except NoSolution:
            largest = None
        if largest is not None and largest.delay_s >= delay_s:
            gain = certified_gain(model, model.loop(largest.K, delay_s), 0).gain
            high = min(gamma, gain)
            if best is None or gain < best.gain:
                best = SpeedDesign(largest.K, delay_s, gain)
        elif best is None:
            low, high = high, high * _CCL_SPAN
        else:
            low = gamma
        if best is not None and high - low < 1e-3 * high:
            break
    if best is None:
        raise NoSolution(f"Algorithm 4.2 for a delay of {delay_s * 1e3:g} ms", "no gain was found")
    return best


def _needed(model: SpeedModel, request: DesignRequest) -> float | None:
    assert request.gamma is not None
    try:
        return _largest(model, request, request.gamma).delay_s
    except NoSolution:
        return None
