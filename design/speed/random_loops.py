"""Each controller's periods under random losses (:mod:`servobench.design.sampled.jump_loop`).

A reading that is lost leaves the controller with what it knows. A command that is lost leaves the drive with
the one before; the controller does not know, and takes it for one that acts.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

from servobench.design.delay.delay_loop import Array
from servobench.design.sampled.held_loop import HeldLoop, Operation, PeriodStep, Strategy, Switch
from servobench.design.sampled.jump_loop import Outcome
from servobench.design.speed.fused_loop import FusedLoop
from servobench.design.speed.hinf_loop import HinfLoop
from servobench.design.speed.loss_certificate import lossy_hinf
from servobench.design.speed.predictor_loop import AdaptiveFilter, PredictorLoop, Walks, load_step
from servobench.design.speed.predictor_plant import KalmanModel, of_state

_RUN_MAX, _BEFORE_MAX = 10, 3
"""Losses in a row beyond which the filter's gains are those of so many: since the last reading, and before
that."""
_FORGOTTEN = 6
"""Readings after which a step of the load is forgotten."""
_SETTLED = 60
"""Periods in which a filter has seen a load step."""


class RandomHeld:
    """u = K x; a sample that is lost, or whose command is, leaves the input as it is."""

    quiet = 0

    def __init__(self, loop: HeldLoop) -> None:
        self.loop, self.period_s = loop, loop.network.period_s
        network, self.newest = loop.network, len(loop.model.A) + 1
        self._packets = network.losses_max if network.strategy is Strategy.HISTORY else 0
        """Losses in a row that the packets' history makes up for."""
        self._applied = PeriodStep(0, 0, (Switch(network.behind, network.offset_s),))

    def struck(self, memory: int) -> int:
        return memory

    def after(self, memory: int, outcome: Outcome) -> int:
        return min(memory + 1, self._packets + 1) if any(outcome) and self._packets else 0

    def chain(self, memory: int, outcome: Outcome) -> list[Operation]:
        held = any(outcome) and memory >= self._packets
        return self.loop.chain(PeriodStep(0, 0, ()) if held else self._applied)


class RandomHinf:
    """An H-infinity controller, which holds the last error through losses."""

    quiet = 0

    def __init__(self, own: HinfLoop) -> None:
        self.loop, self.period_s = lossy_hinf(own, 0), own.period_s
        self.newest = own.first_command + self.loop.size - own.first_state
        self._lost = list(self.loop.chain(PeriodStep(0, 0, ())))
        self._came = list(self.loop.chain(PeriodStep(0, 0, (Switch(0, 0.0),))))

    def struck(self, memory: int) -> int:
        return memory

    def after(self, memory: int, outcome: Outcome) -> int:  # noqa: ARG002
        return memory

    def chain(self, memory: int, outcome: Outcome) -> list[Operation]:  # noqa: ARG002
        return sent(self._lost if outcome.reading else self._came, outcome)


class RandomFused:
    """A predictor on count and speed; ``gains``: L (4, 2) after 0, 1 .. losses and more."""

    quiet = 0

    def __init__(self, own: FusedLoop, gains: Sequence[Array]) -> None:
        self.loop, self.period_s, self.newest = own, own.period_s, own.first_command
        self._last = len(gains) - 1
        self._lost = own.chain(None)
        self._came = [own.chain(L) for L in gains]

    def struck(self, memory: int) -> int:
        return memory

    def after(self, memory: int, outcome: Outcome) -> int:
        return min(memory + 1, self._last) if outcome.reading else 0

    def chain(self, memory: int, outcome: Outcome) -> list[Operation]:
        return sent(self._lost if outcome.reading else self._came[memory], outcome)


class _History(NamedTuple):
    """What a predictor's filter goes by: how many more readings count as steps, readings since (up to
    :data:`_FORGOTTEN`), losses before the last one, losses since."""

    steps: int
    since: int
    before: int
    run: int


class RandomPredictor:
    """A predictor whose filter's gains follow losses, and load steps by the first readings after them.

    How many readings count as steps is that of a load step of ``load_nm`` without losses and noise. Of losses
    the gains follow the last two runs; before these every reading counts as received.
    """

    quiet = _History(0, _FORGOTTEN, 0, 0)

    def __init__(self, own: PredictorLoop, kalman: KalmanModel, walks: Walks, load_nm: float) -> None:
        self.loop, self.period_s, self.newest = own, own.period_s, own.first_command
        self.kalman, self.walks = kalman, walks
        filtering = AdaptiveFilter(kalman, walks)
        load_step(own.prediction, filtering, load_nm, _SETTLED)
        self._steps = filtering.steps_seen
        self._lost = own.chain(None)

    def struck(self, memory: _History) -> _History:
        return memory._replace(steps=self._steps, since=0 if self._steps else memory.since)

    def after(self, memory: _History, outcome: Outcome) -> _History:
        steps, since, _, run = memory
        if outcome.reading:
            return memory._replace(run=min(run + 1, _RUN_MAX))
        since = 0 if steps else min(since + 1, _FORGOTTEN)
        return _History(max(0, steps - 1), since, min(run, _BEFORE_MAX), 0)

    def chain(self, memory: _History, outcome: Outcome) -> list[Operation]:
        return sent(self._lost if outcome.reading else self._came(memory), outcome)

    @cache  # noqa: B019 - a loop lives as long as its analysis
    def _came(self, memory: _History) -> list[Operation]:
        """Return a period that begins with a reading."""
        walks, kalman = self.walks, self.kalman
        steps, since, before, run = memory
        bold = steps > 0
        P = kalman.settled(walks.quiet if since == _FORGOTTEN and not bold else walks.bold)
        gaps = [before] if bold or since in (0, _FORGOTTEN) else [*[0] * (since - 1), before]
        # the last of the readings that count as steps leaves the bold covariance
        for place, gap in enumerate(gaps):
            walk = walks.bold if bold or (since == 0 and place == 0) else walks.quiet
            P = kalman.corrected(self._later(P, walk, gap + 1))
        walk = walks.bold if bold else walks.quiet
        return self.loop.chain(of_state(kalman.gain(self._later(P, walk, run + 1))))

    def _later(self, P: Array, walk: float, periods: int) -> Array:
        for _ in range(periods):
            P = self.kalman.predicted(P, walk)
        return P


def sent(period: Sequence[Operation], outcome: Outcome) -> list[Operation]:
    """Return a period without the jump of its command, if that is lost."""
    sampled, until, acting, *rest = period
    return [sampled, until, *rest] if outcome.command else [sampled, until, acting, *rest]
