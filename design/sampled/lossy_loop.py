"""The loop of a controller with its own states, whose samples may be lost: linear, from sample to sample.

    xi = [x, w | states of the controller and commands on their way]

Each command acts a constant delay after its sample was due, whether the sample came or not: the controller
goes on with what it has. The effect of a period depends on whether its sample came, and on how many before it
were lost, as a filter's gain may follow them. Such a gain may also lie anywhere in a hull: the loop then has
variants, one for each corner, and since the jump at a sample is affine in the gain, a convex function that
falls along every variant falls along all between them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servobench.design.delay.delay_loop import Array
from servobench.design.delay.speed_loop import SpeedModel
from servobench.design.sampled.held_loop import (
    Jump,
    Operation,
    PeriodStep,
    SampledNetwork,
    Strategy,
    SwitchedLoop,
)

Period = tuple[Operation, ...]


@dataclass(frozen=True, slots=True, eq=False)
class LossyPeriods:
    """Possible periods: chains of operations on xi."""

    lost: Period
    came: tuple[Period, ...]
    """After 0, 1 .. losses in a row."""
    corners: tuple[tuple[Period, ...], ...]
    """The same for each corner of the hull of its gain."""

    def ordered(self, order: Sequence[int]) -> "LossyPeriods":
        """Return the same with the entries of xi in another order."""
        return LossyPeriods(
            _ordered(self.lost, order),
            tuple(_ordered(each, order) for each in self.came),
            tuple(tuple(_ordered(each, order) for each in corners) for corners in self.corners),
        )


class LossyLoop(SwitchedLoop):
    """``periods`` of ``model``; as many losses in a row as ``periods`` knows of."""

    def __init__(
        self, model: SpeedModel, period_s: float, delay_s: float, periods: LossyPeriods, kept: int
    ) -> None:
        first = periods.lost[0]
        assert isinstance(first, Jump)
        losses = len(periods.came) - 1
        network = SampledNetwork(Strategy.STAMP, period_s, losses, delay_s, delay_s)
        super().__init__(model, network, len(first.J), kept)
        self._periods = periods

    def chain(self, step: PeriodStep) -> list[Operation]:
        return list(self._periods.came[step.source] if step.switches else self._periods.lost)

    def variants(self, step: PeriodStep) -> list[list[Operation]]:
        if not step.switches:
            return [self.chain(step)]
        return [list(each) for each in self._periods.corners[step.source]]


def _ordered(period: Period, order: Sequence[int]) -> Period:
    rows = np.ix_(order, order)
    return tuple(Jump(each.J[rows]) if isinstance(each, Jump) else each for each in period)


def with_entry(J: Array, row: Array) -> Array:
    """Return J of xi with one more entry at its end, which becomes ``row`` (size + 1,) times xi."""
    larger = np.zeros((len(J) + 1, len(J) + 1))
    larger[:-1, :-1] = J
    larger[-1] = row
    return larger
