"""Random sampled loops, for the certificates."""

from dataclasses import replace

import numpy as np

from servobench.design.delay.certificate import certified_gain
from servobench.design.delay.delay_loop import speed_model
from servobench.design.delay.delay_norm import hinf_norm, largest_stable_delay_s
from servobench.design.errors import NoSolution
from servobench.design.sampled.analysis import analyse_sampled
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from tests.motors import LING


def random_loop(
    draw: np.random.Generator, delay_periods: float, losses_below: int, crossing_min: float
) -> HeldLoop:
    """A sampled loop, stable or not.

    ``delay_periods``: the most, in periods; ``crossing_min``: the least phase that its oldest sample and its
    current loop cost together at the crossing frequency, rad.
    """
    period_s = float(np.exp(draw.uniform(np.log(0.0005), np.log(0.01))))
    bandwidth_hz = float(np.exp(draw.uniform(np.log(30.0), np.log(800.0))))
    delay_s = period_s * float(draw.uniform(0.0, delay_periods))
    network = SampledNetwork(Strategy.ARRIVAL, period_s, int(draw.integers(0, losses_below)), delay_s)
    model = speed_model(LING, current_bandwidth_hz=bandwidth_hz)
    crossing_rad_s = float(draw.uniform(crossing_min, 0.6)) / (network.age_max_s + 1.0 / (6.3 * bandwidth_hz))
    K = np.array([float(draw.uniform(-0.3, 0.1)), -crossing_rad_s / float(model.A[1, 0])])
    return HeldLoop(model, K, network)


def random_bounds(draw: np.random.Generator) -> tuple[float, float | None]:
    """Found and certified gain, rad/s per N m, of a stable loop that ``draw`` makes."""
    while True:
        loop = random_loop(draw, delay_periods=1.5, losses_below=4, crossing_min=0.05)
        analysis = analyse_sampled(loop.model, loop.K, loop.network)
        if not analysis.refuted:
            return analysis.gain_found, analysis.gain_certified


def order_is_found(draw: np.random.Generator) -> bool:
    """Whether the certificate of an order that ``draw`` chooses is found for a stable loop that it makes.

    Error: AssertionError for a certificate below the exact gain.
    """
    while True:
        motor = replace(LING, inertia_kg_m2=LING.inertia_kg_m2 * float(np.exp(draw.uniform(-3.0, 3.0))))
        bandwidth_hz = float(np.exp(draw.uniform(np.log(30.0), np.log(1500.0))))
        model = speed_model(motor, current_bandwidth_hz=bandwidth_hz)
        delay_s = float(np.exp(draw.uniform(np.log(3e-4), np.log(0.3))))
        crossing_rad_s = float(draw.uniform(0.1, 1.2)) / (delay_s - 1.0 / float(model.A[0, 0]))
        loop = model.loop([draw.uniform(-0.4, 0.1), -crossing_rad_s / float(model.A[1, 0])], delay_s)
        if delay_s < 0.8 * largest_stable_delay_s(loop):
            break
    try:
        found = certified_gain(model, loop, int(draw.integers(0, 5)))
    except NoSolution:
        return False
    assert found.gain >= hinf_norm(loop) * (1.0 - 1e-9)
    return True
