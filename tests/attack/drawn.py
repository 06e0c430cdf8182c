"""Loops with everything drawn: motor, encoder, drive, period, delay, losses and structure."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from servobench.design.delay.delay_loop import model_of
from servobench.design.errors import DesignError
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.sampled.jump_loop import Remembering
from servobench.design.sampled.varying_delay import DelayRange
from servobench.design.speed.fused_design import FusedWalks, fused_filter, rounding
from servobench.design.speed.fused_loop import FusedLoop
from servobench.design.speed.hinf_design import HinfWeights, design_controller
from servobench.design.speed.hinf_loop import HinfLoop, conditioned
from servobench.design.speed.predictor_design import PredictorRequest
from servobench.design.speed.predictor_loop import Prediction, PredictorLoop, Walks
from servobench.design.speed.predictor_plant import encoder_noise_rad_s
from servobench.design.speed.random_loops import RandomFused, RandomHeld, RandomHinf, RandomPredictor
from tests.motors import LING

TICK_HZ = 16_000.0


class DrawnLoop(NamedTuple):
    """A loop as the certificate knows it, and ``told`` to the attack."""

    controller: Remembering
    readings: int
    commands: int
    inertias: tuple[float, float]
    """Smallest and largest, as multiples of the one that the controller knows."""
    delays: DelayRange | None
    """None: as the controller knows it."""
    told: dict[str, Any]


def drawn_loop(seed: int) -> DrawnLoop | None:
    """Draw a loop, stable or not; None where there is no such controller."""
    draw = np.random.default_rng([40, seed])

    def between(low: float, high: float) -> float:
        return float(np.exp(draw.uniform(math.log(low), math.log(high))))

    motor = replace(
        LING,
        inertia_kg_m2=LING.inertia_kg_m2 * between(0.1, 10.0),
        viscous_friction_nm_s=LING.viscous_friction_nm_s * between(0.3, 3.0),
    )
    period_s = between(0.5e-3, 10e-3)
    counts, corner_hz = int(2 ** draw.integers(12, 21)), between(100.0, 1000.0)
    request = PredictorRequest(
        motor,
        between(100.0, 1500.0),
        corner_hz,
        encoder_noise_rad_s(counts, corner_hz, TICK_HZ),
        0.005 * motor.rated_torque_nm,
        period_s,
        period_s * float(draw.choice([draw.uniform(0.0, 2.0), 1.0])),
        1.0,
        motor.rated_torque_nm,
        1e-4,
    )
    kind = ("static", "predictor", "fused", "hinf")[int(draw.integers(4))]
    try:
        controller, own = _KINDS[kind](request, counts, between)
    except (DesignError, np.linalg.LinAlgError, ValueError):
        return None
    readings, commands = int(draw.integers(0, 4)), int(draw.integers(0, 2))
    if kind == "static":  # whatever is lost, its input stays: both together are losses of one frame
        commands = 0
    # a predictor's certificate over inertias and losses at once takes minutes
    ranged = draw.random() < 0.5 and not (kind == "predictor" and readings)
    spread = draw.uniform(0.02, 0.3) if ranged else 0.0
    inertias = (1.0 - spread, 1.0 + spread)
    delays = None
    if draw.random() < 0.4 and not (kind == "predictor" and (readings or ranged)):
        least, wide = (
            period_s * math.floor(request.delay_s / period_s + 1e-9),
            period_s * draw.uniform(0.02, 0.3),
        )
        least_s, most_s = max(least, request.delay_s - wide), min(least + period_s, request.delay_s + wide)
        delays = DelayRange(least_s, most_s)
    told = {
        "kind": kind,
        "seed": seed,
        "inertias": inertias,
        "inertia": motor.inertia_kg_m2,
        "friction": motor.viscous_friction_nm_s,
        "rate": request.current_rate_rad_s,
        "filter": request.plant.filter_rate_rad_s,
        "period": period_s,
        "delay": request.delay_s,
        "delays": delays or (request.delay_s, request.delay_s),
        "readings": readings,
        "commands": commands,
    }
    return DrawnLoop(controller, readings, commands, inertias, delays, told | own)


Draw = Callable[[float, float], float]


def _static(request: PredictorRequest, counts: int, between: Draw) -> tuple[Remembering, dict[str, Any]]:  # noqa: ARG001
    plant, h = request.plant, request.period_s
    model = model_of(
        plant.current_rate_rad_s, 1.0, plant.inertia_kg_m2, plant.viscous_friction_nm_s, integral=False
    )
    crossing = between(0.05, 0.5) / (h + request.delay_s + 1.0 / plant.current_rate_rad_s)
    gains = np.array([between(1.0, 1.5) - 1.2, -crossing * plant.inertia_kg_m2])
    network = SampledNetwork(Strategy.STAMP, h, 3, request.delay_s, request.delay_s)
    return RandomHeld(HeldLoop(model, gains, network)), {"gains": gains.tolist()}


def _feedback(request: PredictorRequest, between: Draw) -> np.ndarray:
    around_s = request.period_s + request.delay_s
    slow, fast = between(0.1, 1.0) / around_s, between(0.5, 1.5) * request.current_rate_rad_s
    return request.plant.feedback(slow, max(fast, 2.0 * slow))


def _predictor(request: PredictorRequest, counts: int, between: Draw) -> tuple[Remembering, dict[str, Any]]:  # noqa: ARG001
    feedback, rated = _feedback(request, between), request.motor.rated_torque_nm
    quiet = between(0.05, 5.0)
    walks = Walks(quiet * rated, quiet * between(1.0, 10.0) * rated)
    loop = PredictorLoop(Prediction(request.plant, request.period_s, request.delay_s, feedback))
    told = {
        "gains_of_state": feedback[:2].tolist(),
        "walks": [walks.quiet, walks.bold],
        "speed_noise": request.speed_noise_rad_s,
        "torque_noise": request.torque_noise_nm,
    }
    return RandomPredictor(loop, request.kalman, walks, 1.0), told


def _fused(request: PredictorRequest, counts: int, between: Draw) -> tuple[Remembering, dict[str, Any]]:
    feedback, rated = _feedback(request, between), request.motor.rated_torque_nm
    load = between(0.05, 5.0) * rated
    speed = between(0.01, 1.0) * load * request.period_s / request.motor.inertia_kg_m2
    noise = rounding(counts, request.speed_filter_hz, TICK_HZ)
    filtering = fused_filter(request.plant, request.period_s, noise, request.torque_noise_nm)
    gains = filtering.gains(FusedWalks(load, speed), 5)
    loop = FusedLoop(Prediction(request.plant, request.period_s, request.delay_s, feedback))
    told = {"gains_of_state": feedback[:2].tolist(), "gains": [L.tolist() for L in gains]}
    return RandomFused(loop, gains), told


def _hinf(request: PredictorRequest, counts: int, between: Draw) -> tuple[Remembering, dict[str, Any]]:  # noqa: ARG001
    around_s, unit = request.period_s + request.delay_s, request.floor_rad_s()
    weights = HinfWeights(between(0.2, 1.5) / unit, between(0.05, 1.5) * unit, between(0.1, 0.5) / around_s)
    own = conditioned(design_controller(request, weights).K, unit)
    told = {key: getattr(own, key).tolist() for key in "ABLC"} | {"D": own.D}
    return RandomHinf(HinfLoop(own, request.plant, request.delay_s)), told


_KINDS = {"static": _static, "predictor": _predictor, "fused": _fused, "hinf": _hinf}
