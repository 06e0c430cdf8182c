"""The analysis behind ``hil analyse peaks``: a controller's file where readings and commands are lost."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from servobench.design.errors import NoSolution
from servobench.design.sampled.analysis import analyse_loop, with_peak
from servobench.design.sampled.held_loop import HeldLoop, Strategy
from servobench.design.sampled.jump_loop import Remembering
from servobench.design.sampled.loss_decay import DecayPerSecond, losses_decay
from servobench.design.sampled.loss_gain import GainBound, losses_gain
from servobench.design.sampled.loss_peak import losses_peak
from servobench.design.sampled.peak_steps import PeakBound
from servobench.design.sampled.varying_delay import DelayRange
from servobench.design.speed.predictor_decay import predictor_decay
from servobench.design.speed.predictor_peaks import predictor_peak
from servobench.design.speed.random_loops import RandomHeld, RandomPredictor
from servobench.hil.configuration.controller_kinds import StateFeedbackController
from servobench.hil.studies.speed.random_losses import Designed, remembering_of


def peaks_figures(
    controller: Designed,
    path: Path,
    readings_max: int,
    commands_max: int,
    load_nm: float | None,
    inertias: tuple[float, float] = (1.0, 1.0),
    delays: DelayRange | None = None,
    *,
    decay: bool = False,
    gain: bool = False,
) -> dict[str, Any]:
    """Return the largest error after a load step, certified and found, for each number of losses in a row;
    with ``decay`` the slowest decay too, with ``gain`` the gain.

    ``load_nm``: None: that of the file's design, or 1 N m; ``inertias``: smallest and largest, as multiples
    of the one that the controller was made for; ``delays``: None: those that it was made for. Raises BadInput
    for a file that does not tell what it was made for.
    """
    told = None if isinstance(controller, StateFeedbackController) else controller.figures
    load_nm = load_nm or (1.0 if told is None else told.load_nm)
    remembering = remembering_of(controller, path, load_nm, None if delays is None else delays.most_s)
    delays = delays or _arriving(remembering)
    return {
        "controller": controller.kind,
        "load_nm": load_nm,
        "inertia_percent": [100.0 * each for each in inertias],
        "delay_ms": None if delays is None else [1e3 * each for each in delays],
        "peaks": [
            _bounded(remembering, readings, commands, load_nm, inertias, delays)
            | (_decaying(remembering, readings, commands, inertias, delays) if decay else {})
            | (_amplifying(remembering, readings, commands, inertias, delays) if gain else {})
            for readings in range(readings_max + 1)
            for commands in range(commands_max + 1)
        ],
    }


def peak_of(
    remembering: Remembering,
    readings_max: int,
    commands_max: int,
    inertias: tuple[float, float] = (1.0, 1.0),
    delays: DelayRange | None = None,
) -> PeakBound:
    """Return the largest error after a load step of 1 N m, with at most so many readings and commands lost in
    a row, over a range of inertias and of delays.

    ``delays``: None: those of the loop, of a static gain that applies samples as they arrive any up to the
    largest. Raises NoSolution.
    """
    remembering, alone, delays = _losing(remembering, readings_max, commands_max, inertias, delays)
    if alone is not None:
        return _peak_of_static_gain(alone)
    if isinstance(remembering, RandomPredictor):
        made = remembering
        return predictor_peak(
            made.loop, made.kalman, made.walks, readings_max, commands_max, inertias, delays
        )
    return losses_peak(remembering, readings_max, commands_max, inertias, delays)


def decay_of(
    remembering: Remembering,
    readings_max: int,
    commands_max: int,
    inertias: tuple[float, float] = (1.0, 1.0),
    delays: DelayRange | None = None,
) -> DecayPerSecond:
    """Return the slowest decay of the same set as :func:`peak_of`, 1/s. Raises NoSolution."""
    remembering, alone, delays = _losing(remembering, readings_max, commands_max, inertias, delays)
    if alone is not None:
        return _decay_of_static_gain(alone)
    if isinstance(remembering, RandomPredictor):
        made, losses = remembering, (readings_max, commands_max)
        return predictor_decay(made.loop, made.kalman, made.walks, losses, inertias, delays)
    return losses_decay(remembering, readings_max, commands_max, inertias, delays)


def gain_of(
    remembering: Remembering,
    readings_max: int,
    commands_max: int,
    inertias: tuple[float, float] = (1.0, 1.0),
    delays: DelayRange | None = None,
) -> GainBound:
    """Return the gain over the same set as :func:`peak_of`, rad/s per N m. Raises NoSolution."""
    remembering, alone, delays = _losing(remembering, readings_max, commands_max, inertias, delays)
    if alone is not None:
        return _gain_of_static_gain(alone)
    if isinstance(remembering, RandomPredictor):
        raise NoSolution(
            "certificate of the gain", "not made for a predictor here: that of its file is over lost readings"
        )
    if delays is not None:
        raise NoSolution("certificate of the gain", "not made over delays that vary")
    return losses_gain(remembering, readings_max, commands_max, inertias)


def _losing(
    remembering: Remembering,
    readings_max: int,
    commands_max: int,
    inertias: tuple[float, float],
    delays: DelayRange | None,
) -> tuple[Remembering, HeldLoop | None, DelayRange | None]:
    """Return the controller where so many readings are lost, and the delays; a static gain's loop beside it
    where its own analysis covers all that is asked."""
    if not isinstance(remembering, RandomHeld):
        return remembering, None, delays
    own, arriving = remembering.loop, _arriving(remembering)
    loop = HeldLoop(own.model, own.K, replace(own.network, losses_max=readings_max))
    alone = inertias == (1.0, 1.0) and not commands_max and delays == arriving
    return RandomHeld(loop), loop if alone else None, delays or arriving


def _gain_of_static_gain(loop: HeldLoop) -> GainBound:
    analysis = analyse_loop(loop)
    if analysis.gain_certified is None:
        raise NoSolution("certificate of the gain", analysis.without_certificate)
    return GainBound(analysis.gain_certified, analysis.gain_found)


def _decay_of_static_gain(loop: HeldLoop) -> DecayPerSecond:
    analysis = analyse_loop(loop)
    if analysis.decay_certified_per_s is None:
        raise NoSolution("certificate of the decay", analysis.without_certificate)
    return DecayPerSecond(analysis.decay_certified_per_s, analysis.decay_found_per_s)


def _arriving(remembering: Remembering) -> DelayRange | None:
    """Return the delays of a static gain that applies samples as they arrive; None: they do not vary."""
    if not isinstance(remembering, RandomHeld):
        return None
    network = remembering.loop.network
    varying = network.strategy is Strategy.ARRIVAL and network.delay_max_s > 0.0
    return DelayRange(0.0, network.delay_max_s) if varying else None


def _peak_of_static_gain(loop: HeldLoop) -> PeakBound:
    analysis = with_peak(analyse_loop(loop))
    if analysis.peak_certified is None:
        raise NoSolution("certificate of the peak", analysis.without_certificate)
    return PeakBound(analysis.peak_certified, analysis.peak_found)


def _bounded(
    remembering: Remembering,
    readings: int,
    commands: int,
    load_nm: float,
    inertias: tuple[float, float],
    delays: DelayRange | None,
) -> dict[str, Any]:
    lost = {"readings_lost_in_a_row": readings, "commands_lost_in_a_row": commands}
    try:
        peak = peak_of(remembering, readings, commands, inertias, delays)
    except NoSolution as error:
        return lost | {"not_certified": str(error)}
    return lost | {
        "peak_certified_rad_s": load_nm * peak.certified,
        "peak_found_rad_s": load_nm * peak.reached,
    }


def _decaying(
    remembering: Remembering,
    readings: int,
    commands: int,
    inertias: tuple[float, float],
    delays: DelayRange | None,
) -> dict[str, Any]:
    try:
        bound = decay_of(remembering, readings, commands, inertias, delays)
    except NoSolution as error:
        return {"decay_not_certified": str(error)}
    return {"decay_certified_per_s": bound.certified, "decay_found_per_s": bound.found}


def _amplifying(
    remembering: Remembering,
    readings: int,
    commands: int,
    inertias: tuple[float, float],
    delays: DelayRange | None,
) -> dict[str, Any]:
    try:
        bound = gain_of(remembering, readings, commands, inertias, delays)
    except NoSolution as error:
        return {"gain_not_certified": str(error)}
    return {"gain_certified": bound.certified, "gain_found": bound.found}
