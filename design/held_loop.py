"""The loop that really runs: sampled, held, with delay and loss, as a linear system from sample to sample.

    x' = A x + B1 u + B2 d      z = C x      u = K x(s), held; s is the sample that is applied

A sensor samples at 0, h, 2h ... A sample arrives after at most T, and at most D in a row are lost.
Which sample is applied when is the strategy's:

    arrival   the newest, as soon as it arrives                    age     0 .. (D + 1) h + T
    stamp     x(k h) at k h + eta if it came, else the last held   age   eta .. eta + (D + 1) h
    history   x(k h) at k h + eta, always: each packet carries     age   eta .. eta + h
              the last D + 1 samples, so the latest that is needed is there by D h + T

The state between two instants is xi = [x, w, v_1 .. v_m]: w the input that is held, v_j = K x of the
j-th sample back that is not applied yet. Every step is a chain of two operations: a jump xi -> J xi,
and a flow of some length with u = w.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.linalg import expm

from design.delay_loop import Array
from design.errors import UnsuitableNetwork
from design.speed_loop import SpeedModel

_WHOLE = 1e-9
"""Part of a period by which a delay may miss a multiple of it and still count as one."""


class Strategy(Enum):
    """When a sample is applied."""

    ARRIVAL = "arrival"
    STAMP = "stamp"
    HISTORY = "history"


@dataclass(frozen=True, slots=True)
class SampledNetwork:
    """What the network does at worst, and what is done about it. Raises UnsuitableNetwork."""

    strategy: Strategy
    period_s: float
    losses_max: int
    """D: samples lost in a row."""
    delay_max_s: float
    """T: from sample to actuator."""
    agreed_delay_s: float = 0.0
    """eta of the strategies stamp and history."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.period_s) and self.period_s > 0.0):
            raise UnsuitableNetwork(f"a period of {self.period_s * 1e3:g} ms", "more than 0")
        if self.losses_max < 0:
            raise UnsuitableNetwork(f"{self.losses_max} losses in a row", "0 or more")
        if not (math.isfinite(self.delay_max_s) and self.delay_max_s >= 0.0):
            raise UnsuitableNetwork(f"a delay of {self.delay_max_s * 1e3:g} ms", "0 or more")
        slack = _WHOLE * self.period_s
        if self.strategy is Strategy.ARRIVAL:
            if self.delay_max_s > self.period_s + slack:
                raise UnsuitableNetwork(
                    f"a delay of up to {self.delay_max_s * 1e3:g} ms applied on arrival",
                    f"at most the period of {self.period_s * 1e3:g} ms, so that samples arrive in order; "
                    "with a longer delay use the strategy stamp or history",
                )
            return
        needed = self.delay_max_s
        if self.strategy is Strategy.HISTORY:
            needed += self.losses_max * self.period_s
        if self.agreed_delay_s < needed - slack:
            raise UnsuitableNetwork(
                f"an agreed delay of {self.agreed_delay_s * 1e3:g} ms for {self.strategy.value}",
                f"at least {needed * 1e3:g} ms, by when the sample certainly is there",
            )

    @property
    def age_max_s(self) -> float:
        """Oldest that an applied sample can become, s."""
        if self.strategy is Strategy.ARRIVAL:
            return (self.losses_max + 1) * self.period_s + self.delay_max_s
        if self.strategy is Strategy.STAMP:
            return self.agreed_delay_s + (self.losses_max + 1) * self.period_s
        return self.agreed_delay_s + self.period_s


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
class Delivery:
    """A sample that came, after ``delay_s``, and the next one that comes is ``interval`` periods later."""

    interval: int
    delay_s: float


class HeldLoop:
    """``model`` closed by u = K x over ``network``."""

    def __init__(self, model: SpeedModel, K: Array, network: SampledNetwork) -> None:
        self.model = model
        self.K = np.asarray(K, dtype=float)
        self.network = network
        n = len(model.A)
        self._behind, self._offset_s = 0, 0.0
        if network.strategy is not Strategy.ARRIVAL:
            self._behind = math.floor(network.agreed_delay_s / network.period_s + _WHOLE)
            self._offset_s = max(0.0, network.agreed_delay_s - self._behind * network.period_s)
        self.size = n + 2 + self._behind
        """Of xi."""
        self.kept = n + 1 + self._behind
        """So many entries of xi, the first, matter from one sample to the next."""

    def step(self, delivery: Delivery) -> list[Operation]:
        """From one delivered sample to the next one that is delivered; time passed: interval x period."""
        if self.network.strategy is Strategy.ARRIVAL:
            rest_s = delivery.interval * self.network.period_s - delivery.delay_s
            return [self._sample(), Flow(delivery.delay_s), self._apply(), Flow(rest_s)]
        chain = self.sample_step(True)
        for _ in range(delivery.interval - 1):
            chain += self.sample_step(False)
        return chain

    def sample_step(self, came: bool) -> list[Operation]:
        """One period of stamp or history; ``came``: the sample whose time to be applied falls into it."""
        apply = [self._apply()] if came else []
        rest_s = self.network.period_s - self._offset_s
        return [self._sample(), Flow(self._offset_s), *apply, Flow(rest_s)]

    def transition(self, chain: list[Operation]) -> Array:
        """The product of a chain, (size, size)."""
        total = np.eye(self.size)
        for operation in chain:
            total = (operation.J if isinstance(operation, Jump) else self._flow(operation.length_s)) @ total
        return total

    def kept_transition(self, chain: list[Operation]) -> Array:
        """The same between the entries that matter."""
        return self.transition(chain)[: self.kept, : self.kept]

    def _flow(self, length_s: float) -> Array:
        n = len(self.model.A)
        M = np.zeros((n + 1, n + 1))
        M[:n, :n], M[:n, n] = self.model.A, self.model.B1
        total = np.eye(self.size)
        total[: n + 1, : n + 1] = expm(M * length_s)
        return total

    def _sample(self) -> Jump:
        """A sample is taken: v_1 = K x, and all others move on."""
        n = len(self.model.A)
        J = np.eye(self.size)
        J[n + 1 :] = 0.0
        J[n + 1, :n] = self.K
        for place in range(n + 2, self.size):
            J[place, place - 1] = 1.0
        return Jump(J)

    def _apply(self) -> Jump:
        """The sample that has waited longest becomes the input."""
        n = len(self.model.A)
        J = np.eye(self.size)
        J[n] = 0.0
        J[n, self.size - 1] = 1.0
        return Jump(J)


def decay_of(M: Array, time_s: float) -> float:
    """Rate at which xi decays if M, over ``time_s``, is repeated for ever, 1/s; inf for a nilpotent M."""
    radius = float(np.max(np.abs(np.linalg.eigvals(M))))
    return math.inf if radius == 0.0 else -math.log(radius) / time_s
