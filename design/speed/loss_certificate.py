"""Certificates of a predictor, and of an H-infinity controller, over every sequence of lost samples.

The samples are those that a drive sends; every command arrives, and acts the delay of the design after its
sample was due. The plant is that of the design. Through a loss

    H-infinity    the last sample is held, and its states go on as if it had come again
    predictor     the model runs on alone, and the next sample counts for more: all possible gains of the
                  filter, after losses and detected steps too, lie in :class:`GainBoxes`
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.errors import NoSolution
from servobench.design.sampled.analysis import SampledAnalysis, analyse_loop
from servobench.design.sampled.held_loop import Jump, LossyLoop, LossyPeriods, Operation, Period, with_entry
from servobench.design.sampled.loss_patterns import Pattern
from servobench.design.speed.hinf_design import HinfDesign
from servobench.design.speed.hinf_loop import HinfLoop
from servobench.design.speed.plant_loop import split
from servobench.design.speed.predictor_design import PredictorDesign, Sample, losses_gain, samples_gain
from servobench.design.speed.predictor_gains import GainBoxes
from servobench.design.speed.predictor_loop import PredictorLoop
from servobench.design.speed.predictor_plant import FILTERED, of_state

_PERIODS_MAX = 9
"""Periods of a pattern with steps, two rounds at least: by the seventh sample a step is forgotten, and a gain
costs the cube of them."""

Attempt = Callable[[int], SampledAnalysis]


def with_losses(attempt: Attempt, losses_max: int) -> list[SampledAnalysis]:
    """Analyse ``losses_max`` in a row and ever fewer, until one is certified: that is the last."""
    attempts: list[SampledAnalysis] = []
    for losses in range(losses_max, -1, -1):
        attempts.append(attempt(losses))
        if attempts[-1].certified:
            break
    return attempts


def hinf_losses(made: HinfDesign, losses_max: int) -> SampledAnalysis:
    """Analyse an H-infinity controller with at most so many losses in a row. Raises NoSolution."""
    request = made.request
    if (
        request.uneven_s
        and split(request.delay_s, request.period_s)[0] != split(request.delay_max_s, request.period_s)[0]
    ):
        raise NoSolution(
            "certificate for uneven periods",
            "commands act in the period after that of their instant",
            "a delay of whole periods, as where commands act at SYNCs, has none between",
        )
    return analyse_loop(lossy_hinf(made.loop(), losses_max, made.request.uneven_s))


def lossy_hinf(loop: HinfLoop, losses_max: int, uneven_s: float = 0.0) -> LossyLoop:
    """Return ``loop`` with the held error as its last state, before the commands on their way.

    ``uneven_s``: of :class:`SampledNetwork`; commands act a constant delay behind the last sample before.
    """
    first, *rest = loop.chain()
    assert isinstance(first, Jump)
    size, commands = loop.size, slice(loop.first_command, loop.size)
    held, read = np.eye(size + 1)[size], np.eye(size + 1)[FILTERED]
    lost = with_entry(first.J, held)
    lost[commands, size], lost[commands, FILTERED] = -lost[commands, FILTERED], 0.0
    after = [Jump(with_entry(each.J, held)) if isinstance(each, Jump) else each for each in rest]
    came: Period = (Jump(with_entry(first.J, -read)), *after)
    count = losses_max + 1
    order = [
        *range(loop.first_command),
        *range(loop.first_state, size + 1),
        *range(loop.first_command, loop.first_state),
    ]
    periods = LossyPeriods((Jump(lost), *after), (came,) * count, ((came,),) * count).ordered(order)
    # the oldest command is the one in force
    return LossyLoop(loop.model, (loop.controller.period_s, loop.delay_s, uneven_s), periods, size)


def predictor_losses(made: PredictorDesign, losses_max: int) -> SampledAnalysis:
    """Analyse a predictor with at most so many losses in a row; patterns are found with the quiet filter's
    gains, then which samples of the worst count as steps of the load."""
    loop = lossy_predictor(made, losses_max)
    analysis = analyse_loop(loop, (0,))
    patterns = {tuple(losses_of(each)) for each in (analysis.worst.pattern, *analysis.regular)}
    worst = max(sorted(patterns), key=lambda losses: losses_gain(made, losses))
    _, gain = worst_samples(made, worst, losses_max)
    return replace(analysis, worst=replace(analysis.worst, gain=gain))


def worst_samples(
    made: PredictorDesign, losses: Sequence[int], losses_max: int
) -> tuple[tuple[Sample, ...], float]:
    """Return the samples of largest gain found near the pattern ``losses``, and that gain, rad/s per N m.

    A step seen once in a few rounds of the pattern, then single changes of the worst.
    """
    quiet: tuple[Sample, ...] = tuple((lost, False) for lost in losses)
    tried = {quiet: samples_gain(made, quiet)}
    for rounds in range(1, max(2, _PERIODS_MAX // (sum(losses) + len(losses))) + 1):
        *before, (lost, _) = quiet * rounds
        tried[(*before, (lost, True))] = samples_gain(made, (*before, (lost, True)))
    worst = max(tried, key=lambda samples: tried[samples])
    for place, (lost, step) in enumerate(worst):
        others = [(lost, not step), (lost - 1, step), (lost + 1, step)]
        for other in others:
            if 0 <= other[0] <= losses_max:
                changed = (*worst[:place], other, *worst[place + 1 :])
                tried[changed] = samples_gain(made, changed)
    worst = max(tried, key=lambda samples: tried[samples])
    return worst, tried[worst]


def filter_gains(made: PredictorDesign, losses_max: int) -> list[list[Array]]:
    """Return the corners of the box of all gains L (4,) of the filter, after 0, 1 .. losses."""
    boxes = GainBoxes(made.request.kalman, made.walks, losses_max)
    return [boxes.corners(lost) for lost in range(losses_max + 1)]


def lossy_predictor(made: PredictorDesign, losses_max: int) -> LossyLoop:
    """Return the loop with every gain that its filter may have."""
    own, request = PredictorLoop(made.prediction), made.request
    losses = range(losses_max + 1)

    def period(L: Array | None) -> tuple[Operation, ...]:
        return tuple(own.chain(L))

    periods = LossyPeriods(
        period(None),
        tuple(period(_quiet_gain(made, lost)) for lost in losses),
        tuple(tuple(map(period, corners)) for corners in filter_gains(made, losses_max)),
    )
    # the oldest command is the one in force
    return LossyLoop(own.model, (request.period_s, request.delay_s, 0.0), periods, own.size - 1)


def _quiet_gain(made: PredictorDesign, lost: int) -> Array:
    """Return L of the first sample after so many losses, before which every one came."""
    kalman, walk = made.request.kalman, made.walks.quiet
    P = kalman.settled(walk)
    for _ in range(lost + 1):
        P = kalman.predicted(P, walk)
    return of_state(kalman.gain(P))


def losses_of(pattern: Pattern) -> list[int]:
    """Return the losses before each received sample of ``pattern``."""
    return [step.source for step in pattern.steps if step.switches]
