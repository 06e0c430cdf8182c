"""Random sampled loops, for the certificates."""

import numpy as np

from design.held_loop import SampledNetwork, Strategy
from design.sampled import analyse_sampled
from design.speed_loop import speed_model
from tests.motors import LING


def random_bounds(draw: np.random.Generator) -> tuple[float, float | None]:
    """Found and certified gain, rad/s per N m, of a stable loop that ``draw`` makes."""
    while True:
        period_s = float(np.exp(draw.uniform(np.log(0.0005), np.log(0.01))))
        bandwidth_hz = float(np.exp(draw.uniform(np.log(30.0), np.log(800.0))))
        delay_s = period_s * float(draw.uniform(0.0, 1.5))
        network = SampledNetwork(Strategy.ARRIVAL, period_s, int(draw.integers(0, 4)), delay_s)
        model = speed_model(LING, current_bandwidth_hz=bandwidth_hz)
        crossing_rad_s = float(draw.uniform(0.05, 0.6)) / (network.age_max_s + 1.0 / (6.3 * bandwidth_hz))
        K = np.array([float(draw.uniform(-0.3, 0.1)), -crossing_rad_s / float(model.A[1, 0])])
        analysis = analyse_sampled(model, K, network)
        if not analysis.refuted:
            return analysis.gain_found, analysis.gain_certified
