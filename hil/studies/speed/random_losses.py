"""The analysis behind ``hil analyse losses``: a controller's file on a network that loses at random."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from servobench.design.delay.delay_loop import model_of
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.sampled.jump_loop import (
    WITHIN,
    JumpLoop,
    LossyLink,
    Moments,
    Remembering,
    exceedance,
    fates_of,
)
from servobench.design.speed.fused_loop import FusedLoop
from servobench.design.speed.hinf_loop import Conditioned, HinfLoop
from servobench.design.speed.predictor_loop import Prediction, PredictorLoop, Walks
from servobench.design.speed.predictor_plant import PredictorPlant, kalman_model
from servobench.design.speed.random_loops import RandomFused, RandomHeld, RandomHinf, RandomPredictor
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import US_PER_S
from servobench.hil.configuration.controller_kinds import HinfSection, StateFeedbackController
from servobench.hil.configuration.network_file import LossChain, Network
from servobench.hil.configuration.predicting_controllers import FusedController, PredictorController
from servobench.hil.studies.numbers import finite

Designed = StateFeedbackController | PredictorController | FusedController | HinfSection
MULTIPLES = (1.25, 1.5, 2.0, 3.0)
"""Thresholds if none is given, in peaks without losses."""
_PERIODS = 200
"""Most periods for which mean and deviation are told."""


def losses_of(network: Network, path: Path, controller: Designed) -> tuple[LossyLink, LossyLink]:
    """Return the losses of readings and of commands. Raises BadInput where the file does not know them, and
    for another period than the controller's."""
    made = controller.made_for
    if made is not None and made.period_us is not None and made.period_us != network.period_us:
        expected = f"{made.period_us}, that of the controller: losses are told for each frame"
        raise BadInput(str(path), "network.period_us", network.period_us, expected)
    readings = _bursts(network.reading_losses, network.loss_percent)
    commands = _bursts(network.command_losses, network.command_loss_percent or 0.0)
    if readings.loss == 0.0 and network.losses_in_a_row_max:
        key = "network.reading_losses"
        expected = "p_good_to_bad, p_bad_to_good, loss_bad and loss_good, as hil measure writes them"
        raise BadInput(str(path), key, "nothing", expected, "or loss_percent, for independent losses")
    return readings, commands


def _bursts(chain: LossChain | None, percent: float) -> LossyLink:
    return LossyLink(loss_good=0.01 * percent) if chain is None else LossyLink(**chain.model_dump())


def losses_figures(
    controller: Designed,
    path: Path,
    losses: tuple[LossyLink, LossyLink],
    load_nm: float | None,
    thresholds_rad_s: list[float],
) -> dict[str, Any]:
    """Return decay in mean square, mean and deviation after a load step, and the probabilities to exceed.

    ``load_nm``: None: that of the file's design, or 1 N m; ``thresholds_rad_s``: empty: multiples of the peak
    without losses. Raises BadInput for a file that does not tell what it was made for.
    """
    told = None if isinstance(controller, StateFeedbackController) else controller.figures
    load_nm = load_nm or (1.0 if told is None else told.load_nm)
    remembering = remembering_of(controller, path, load_nm)
    lossless = JumpLoop(remembering, fates_of(LossyLink(), LossyLink()))
    peak = float(np.abs(lossless.moments().mean).max())
    loop = JumpLoop(remembering, fates_of(*losses))
    decay_per_s = loop.decay_per_s()
    squares, moments = None, None
    if decay_per_s > 0.0:
        squares, moments = loop.squares_to_come(), loop.moments()
    thresholds = thresholds_rad_s or [load_nm * peak * multiple for multiple in MULTIPLES]
    bounds = [exceedance(loop, threshold / load_nm, squares) for threshold in thresholds]
    return {
        "controller": controller.kind,
        "reading_losses": {**losses[0]._asdict(), "share": losses[0].loss},
        "command_losses": {**losses[1]._asdict(), "share": losses[1].loss},
        "stable_in_mean_square": squares is not None,
        "decay_in_mean_square_per_s": finite(decay_per_s),
        "load_nm": load_nm,
        "peak_without_losses_rad_s": load_nm * peak,
        "after_step": None if moments is None else _step_figures(loop, moments, load_nm),
        "exceedance": [
            {"threshold_rad_s": threshold, "probability_least": low, "probability_most": high}
            for threshold, (low, high) in zip(thresholds, bounds, strict=True)
        ],
    }


def _step_figures(loop: JumpLoop, moments: Moments, load_nm: float) -> dict[str, Any]:
    """Return the largest mean and deviation of the error, and both at each period's end."""
    mean, deviation = load_nm * moments.mean, load_nm * moments.deviation
    highest, widest = int(np.argmax(np.abs(mean))), int(np.argmax(deviation))
    tick_s = loop.period_s / WITHIN
    return {
        "mean_largest_rad_s": float(abs(mean[highest])),
        "mean_largest_after_s": tick_s * (highest + 1),
        "deviation_largest_rad_s": float(deviation[widest]),
        "deviation_largest_after_s": tick_s * (widest + 1),
        "error_at_rest_rad_s": load_nm * loop.error_at_rest,
        "means_rad_s": mean[WITHIN - 1 :: WITHIN][:_PERIODS].tolist(),
        "deviations_rad_s": deviation[WITHIN - 1 :: WITHIN][:_PERIODS].tolist(),
    }


def remembering_of(
    controller: Designed, path: Path, load_nm: float, delay_s: float | None = None
) -> Remembering:
    """Return the periods of a file's controller around the plant that it was made for.

    ``delay_s``: from sample to action; None: that which it was made for. Raises BadInput.
    """
    made = controller.made_for
    if made is None or made.plant is None or made.period_us is None or made.delay_max_us is None:
        key = "controller.made_for"
        expected = "plant, period_us and delay_max_us, as hil design speed --network or --losses-max writes"
        raise BadInput(str(path), key, "not all of it", expected)
    period_s, designed_s = made.period_us / US_PER_S, made.delay_max_us / US_PER_S
    rate = made.plant.resistance_ohm / made.plant.inductance_q_h
    if made.current_loop is not None:
        rate = math.tau * made.current_loop.bandwidth_hz
    if isinstance(controller, StateFeedbackController):
        plant = made.plant
        model = model_of(
            rate,
            plant.torque_constant_nm_a,
            plant.inertia_kg_m2,
            plant.viscous_friction_nm_s,
            integral=len(controller.gain) == 3,
        )
        agreed_s, losses = (made.agreed_delay_us or 0) / US_PER_S, made.losses_in_a_row_max or 0
        network = SampledNetwork(Strategy(made.strategy or "arrival"), period_s, losses, designed_s, agreed_s)
        if delay_s is not None:
            network = _as_late(network, delay_s, path)
        return RandomHeld(HeldLoop(model, np.array(controller.gain), network))
    drive = controller.certificate if isinstance(controller, HinfSection) else controller
    if drive is None or drive.speed_filter_hz is None:
        key = "controller.certificate.speed_filter_hz"
        raise BadInput(str(path), key, "nothing", "what hil design speed writes today: make it anew")
    designed_s += (drive.dead_time_us or 0.0) / US_PER_S
    delay_s = designed_s if delay_s is None else delay_s
    shaft_and_drive = PredictorPlant(
        made.plant.inertia_kg_m2,
        made.plant.viscous_friction_nm_s,
        rate,
        math.tau * drive.speed_filter_hz,
    )
    if isinstance(controller, HinfSection):
        own = Conditioned(
            np.array(controller.A),
            np.array(controller.B),
            np.array(controller.L),
            np.array(controller.C),
            controller.D,
            period_s,
        )
        return RandomHinf(HinfLoop(own, shaft_and_drive, delay_s))
    torque, speed = controller.torque_gain, controller.speed_gain_nm_s_rad
    feedback = np.array([torque, speed, 0.0, -1.0 - torque])
    prediction = Prediction(controller.plant, period_s, designed_s, feedback)
    if isinstance(controller, FusedController):
        return RandomFused(
            FusedLoop(prediction, shaft_and_drive, delay_s), list(map(np.array, controller.gains))
        )
    noise = controller.speed_noise_rad_s, controller.torque_noise_nm
    kalman = kalman_model(controller.plant, period_s, *noise)
    walks = Walks(controller.load_noise_nm_sqrt_s, controller.load_noise_max_nm_sqrt_s)
    return RandomPredictor(PredictorLoop(prediction, shaft_and_drive, delay_s), kalman, walks, load_nm)


def _as_late(network: SampledNetwork, delay_s: float, path: Path) -> SampledNetwork:
    """Return ``network`` with another largest delay. Raises BadInput for packets with a history."""
    if network.strategy is Strategy.HISTORY:
        expected = "arrival or stamp, for a range of delays: with a history the agreed one is always kept"
        raise BadInput(str(path), "controller.made_for.strategy", network.strategy.value, expected)
    return replace(network, delay_max_s=delay_s, agreed_delay_s=delay_s)
