"""The loop as it runs: sampled, held, with delay and loss, as a linear system from sample to sample.

    x' = A x + B1 u + B2 d      z = C x      u = K x(s), held; s is the sample that is applied

A sensor samples at 0, h, 2h ... A sample arrives within T, and at most D in a row are lost. A sample that
arrives after a newer one is dropped. The strategy decides which sample is applied, and when:

    arrival   the newest, as soon as it arrives                    age     0 .. (D + 1) h + T
    stamp     x(k h) at k h + eta if it came, else the last held   age   eta .. eta + (D + 1) h
    history   x(k h) at k h + eta, always: each packet carries     age   eta .. eta + h
              the last D + 1 samples, so the latest that is needed is there by D h + T

The state during a period is xi = [x, w, v_0 .. v_m]: w the input that is held, v_j = K x of the sample
that was taken j periods ago, as far back as one may still begin to act. Every step is a chain of two
operations: a jump xi -> J xi, and a flow of some length with u = w.

Periods of a loop under a load, which is one more entry, the last, of their state.

The loop of a controller with its own states, whose samples may be lost: linear, from sample to sample.

    xi = [x, w | states of the controller and commands on their way]

Each command acts a constant delay after its sample was due, whether the sample came or not: the controller
goes on with what it has. The effect of a period depends on whether its sample came, and on how many before it
were lost, as a filter's gain may follow them. Such a gain may also lie anywhere in a hull: the loop then has
variants, one for each corner, and since the jump at a sample is affine in the gain, a convex function that
falls along every variant falls along all between them.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import scipy.linalg
from scipy.linalg import expm

from servobench.design.delay.delay_loop import Array, SpeedModel
from servobench.design.errors import UnsuitableNetwork

_WHOLE = 1e-9
"""Part of a period by which a delay may miss a multiple of it and still count as one."""


class Strategy(Enum):
    """Instant at which a sample is applied."""

    ARRIVAL = "arrival"
    STAMP = "stamp"
    HISTORY = "history"


@dataclass(frozen=True, slots=True)
class SampledNetwork:
    """The network's worst case, and the strategy against it. Raises UnsuitableNetwork."""

    strategy: Strategy
    period_s: float
    losses_max: int
    """D: samples lost in a row."""
    delay_max_s: float
    """T: from sample to actuator."""
    agreed_delay_s: float = 0.0
    """eta of the strategies stamp and history: whole periods count as so many samples later."""
    uneven_s: float = 0.0
    """Largest departure of the distance of two samples from the period; any from one to the next."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.period_s) and self.period_s > 0.0):
            raise UnsuitableNetwork(f"a period of {self.period_s * 1e3:g} ms", "more than 0")
        if not 0.0 <= self.uneven_s < self.period_s:
            raise UnsuitableNetwork(f"samples {self.uneven_s * 1e3:g} ms uneven", "less than a period")
        if self.losses_max < 0:
            raise UnsuitableNetwork(f"{self.losses_max} losses in a row", "0 or more")
        if not (math.isfinite(self.delay_max_s) and self.delay_max_s >= 0.0):
            raise UnsuitableNetwork(f"a delay of {self.delay_max_s * 1e3:g} ms", "0 or more")
        if self.strategy is Strategy.ARRIVAL:
            return
        needed = self.delay_max_s
        if self.strategy is Strategy.HISTORY:
            needed += self.losses_max * self.period_s
        if self.agreed_delay_s < needed - _WHOLE * self.period_s:
            raise UnsuitableNetwork(
                f"an agreed delay of {self.agreed_delay_s * 1e3:g} ms for {self.strategy.value}",
                f"at least {needed * 1e3:g} ms, by when the sample certainly is there",
            )

    @property
    def behind(self) -> int:
        """Periods from a sample to the begin of the last one in which it may begin to act."""
        if self.strategy is Strategy.ARRIVAL:
            return periods_of(self.delay_max_s, self.shortest_s)[0]
        return math.floor(self.agreed_delay_s / self.period_s + _WHOLE)

    @property
    def offset_s(self) -> float:
        """Latest instant of its action in that period."""
        period_s = self.shortest_s if self.strategy is Strategy.ARRIVAL else self.period_s
        return max(0.0, min(self._latest_s - self.behind * period_s, period_s))

    @property
    def shortest_s(self) -> float:
        """Shortest period."""
        return self.period_s - self.uneven_s

    @property
    def longest_s(self) -> float:
        """Longest period."""
        return self.period_s + self.uneven_s

    @property
    def _latest_s(self) -> float:
        return self.delay_max_s if self.strategy is Strategy.ARRIVAL else self.agreed_delay_s

    @property
    def constant_delay_s(self) -> float:
        """Delay of the equivalent loop with a constant delay, [Ling2012] (2.13)."""
        return (self.losses_max + 1) * self.longest_s + self.delay_max_s

    @property
    def age_max_s(self) -> float:
        """Greatest age of an applied sample, s."""
        if self.strategy is Strategy.ARRIVAL:
            return self.constant_delay_s
        if self.strategy is Strategy.STAMP:
            return self.agreed_delay_s + (self.losses_max + 1) * self.longest_s
        return self.agreed_delay_s + self.longest_s


@dataclass(frozen=True, slots=True, eq=False)
class Jump:
    """xi -> J xi at one instant."""

    J: Array


@dataclass(frozen=True, slots=True)
class Flow:
    """Time passes with u = w."""

    length_s: float


Operation = Jump | Flow


@dataclass(frozen=True, slots=True)
class Switch:
    """``at_s`` after a sample is taken, the one taken ``back`` periods before it begins to act."""

    back: int
    at_s: float


@dataclass(frozen=True, slots=True)
class PeriodStep:
    """The network's actions from one sample to the next; nodes:
    :mod:`servobench.design.sampled.admissible_steps`."""

    source: int
    target: int
    switches: tuple[Switch, ...]
    longer_s: float = 0.0
    """By which it is longer than the network's period."""


class HeldInput:
    """``model`` under an input that is held between jumps: xi = [x, w, ...]."""

    def __init__(self, model: SpeedModel, size: int, kept: int) -> None:
        self.model = model
        self.size = size
        """Length of xi."""
        self.kept = kept
        """Number of leading entries of xi that matter from one sample to the next."""

    def transition(self, chain: Sequence[Operation]) -> Array:
        """Return the product of a chain, (size, size)."""
        total = np.eye(self.size)
        for operation in chain:
            total = (operation.J if isinstance(operation, Jump) else self._flow(operation.length_s)) @ total
        return total

    def kept_transition(self, chain: Sequence[Operation]) -> Array:
        """Return the same between the entries that matter."""
        return self.transition(chain)[: self.kept, : self.kept]

    @property
    def generator(self) -> Array:
        """F of xi' = F xi between two switchings, (size, size)."""
        n = len(self.model.A)
        F = np.zeros((self.size, self.size))
        F[:n, :n], F[:n, n] = self.model.A, self.model.B1
        return F

    def _flow(self, length_s: float) -> Array:
        n = len(self.model.A) + 1
        total = np.eye(self.size)
        total[:n, :n] = expm(self.generator[:n, :n] * length_s)
        return total


class SwitchedLoop(HeldInput, ABC):
    """A loop with the jumps of its ``network``."""

    def __init__(self, model: SpeedModel, network: SampledNetwork, size: int, kept: int) -> None:
        super().__init__(model, size, kept)
        self.network = network

    @abstractmethod
    def chain(self, step: PeriodStep) -> list[Operation]:
        """Return the operations of one period: a jump, a flow, and so on."""

    def variants(self, step: PeriodStep) -> list[list[Operation]]:
        """Return the chains whose hull contains that of ``step``: only its own, unless the loop varies."""
        return [self.chain(step)]

    def differences(self, backs: Sequence[int]) -> Array:
        """Return (switchings, kept): what each adds to the input, as a function of xi at the period's
        begin."""
        return np.zeros((len(backs), self.kept))


class HeldLoop(SwitchedLoop):
    """``model`` closed by u = K x over ``network``."""

    def __init__(self, model: SpeedModel, K: Array, network: SampledNetwork) -> None:
        self.K = model.whole(K)
        n = len(model.A)
        super().__init__(model, network, n + 2 + network.behind, n + 1 + network.behind)

    def chain(self, step: PeriodStep) -> list[Operation]:
        chain: list[Operation] = [Jump(self.sampling)]
        at_s = 0.0
        for switch in step.switches:
            chain += [Flow(switch.at_s - at_s), Jump(self.applying(switch.back))]
            at_s = switch.at_s
        return [*chain, Flow(self.network.period_s + step.longer_s - at_s)]

    def differences(self, backs: Sequence[int]) -> Array:
        n = len(self.model.A)
        before = np.eye(self.kept)[n]
        rows = []
        for back in backs:
            value = np.zeros(self.kept)
            if back == 0:
                value[:n] = self.K
            else:
                value[n + back] = 1.0
            rows.append(value - before)
            before = value
        return np.array(rows).reshape(len(backs), self.kept)

    @property
    def sampling(self) -> Array:
        """The jump when a sample is taken: v_0 = K x, and all others move on."""
        n = len(self.model.A)
        J = np.eye(self.size)
        J[n + 1 :] = 0.0
        J[n + 1, :n] = self.K
        for place in range(n + 2, self.size):
            J[place, place - 1] = 1.0
        return J

    def applying(self, back: int) -> Array:
        """Return the jump when the sample of ``back`` periods ago becomes the input."""
        n = len(self.model.A)
        J = np.eye(self.size)
        J[n] = 0.0
        J[n, n + 1 + back] = 1.0
        return J


def periods_of(delay_s: float, period_s: float) -> tuple[int, float]:
    """Return the whole periods before the one in which a delay ends, and the rest: (0, period], or no delay
    at all."""
    back = max(0, math.ceil(delay_s / period_s - _WHOLE) - 1)
    return back, min(delay_s - back * period_s, period_s)


def decay_of(M: Array, time_s: float) -> float:
    """Return the decay rate of xi if M, over ``time_s``, is repeated for ever, 1/s; inf for a nilpotent M."""
    radius = float(np.max(np.abs(np.linalg.eigvals(M))))
    return math.inf if radius == 0.0 else -math.log(radius) / time_s


class LoadedPeriods:
    """Periods of ``loop`` under a load; errors at ``within`` instants of each."""

    def __init__(self, loop: HeldInput, period_s: float, within: int) -> None:
        self._loop, self._period_s, self._within = loop, period_s, within
        model, n = self._loop.model, len(self._loop.model.A)
        self._rates = np.zeros((n + 2, n + 2))  # of [x, u, load]
        self._rates[:n, :n], self._rates[:n, n], self._rates[:n, n + 1] = model.A, model.B1, model.B2
        self._places = [*range(n + 1), self._loop.size]
        self._look = np.zeros(self._loop.size + 1)
        self._look[:n] = math.copysign(1.0, model.C @ model.B2) * model.C
        self._flows: dict[float, Array] = {}

    def begin(self) -> tuple[Array, Array]:
        """Return the state a period after the load came, from rest, and the errors until then."""
        whole, looks = self.period([])
        return whole[:, -1], looks[:, -1]

    def period(self, chain: Sequence[Operation]) -> tuple[Array, Array]:
        """Return a period's map (N, N), and the errors within it (within, N)."""
        at_s, total = 0.0, np.eye(len(self._look))
        looks: list[Array] = []
        whole_s, tick_s = self._period_s * (1.0 + 1e-9), self._period_s / self._within
        for operation in (*chain, None):
            if isinstance(operation, Jump):
                total[:-1] = operation.J @ total[:-1]
                continue
            length_s = self._period_s - at_s if operation is None else operation.length_s
            while (next_s := tick_s * (len(looks) + 1)) <= min(at_s + length_s, whole_s):
                looks.append(self._look @ self.flow(next_s - at_s) @ total)
            total, at_s = self.flow(length_s) @ total, at_s + length_s
        looks += [self._look @ total] * (self._within - len(looks))
        return total, np.array(looks)

    def flow(self, length_s: float) -> Array:
        """Return what passes in ``length_s``, (N, N)."""
        known = self._flows.get(length_s)
        if known is None:
            known = np.eye(len(self._look))
            known[np.ix_(self._places, self._places)] = scipy.linalg.expm(self._rates * length_s)
            self._flows[length_s] = known
        return known


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
        self, model: SpeedModel, times_s: tuple[float, float, float], periods: LossyPeriods, kept: int
    ) -> None:
        """``times_s``: period, delay, and by how much periods are uneven."""
        first = periods.lost[0]
        assert isinstance(first, Jump)
        losses = len(periods.came) - 1
        period_s, delay_s, uneven_s = times_s
        network = SampledNetwork(Strategy.STAMP, period_s, losses, delay_s, delay_s, uneven_s)
        super().__init__(model, network, len(first.J), kept)
        self._periods = periods

    def chain(self, step: PeriodStep) -> list[Operation]:
        own = self._periods.came[step.source] if step.switches else self._periods.lost
        return _longer(own, step.longer_s)

    def variants(self, step: PeriodStep) -> list[list[Operation]]:
        if not step.switches:
            return [self.chain(step)]
        return [_longer(each, step.longer_s) for each in self._periods.corners[step.source]]


def _longer(period: Period, by_s: float) -> list[Operation]:
    """Return a period that ends so much later."""
    *begun, last = period
    if by_s == 0.0:
        return [*begun, last]
    assert isinstance(last, Flow)
    return [*begun, Flow(last.length_s + by_s)]


def _ordered(period: Period, order: Sequence[int]) -> Period:
    rows = np.ix_(order, order)
    return tuple(Jump(each.J[rows]) if isinstance(each, Jump) else each for each in period)


def with_entry(J: Array, row: Array) -> Array:
    """Return J of xi with one more entry at its end, which becomes ``row`` (size + 1,) times xi."""
    larger = np.zeros((len(J) + 1, len(J) + 1))
    larger[:-1, :-1] = J
    larger[-1] = row
    return larger
