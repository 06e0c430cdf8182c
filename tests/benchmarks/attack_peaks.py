"""An attack on certified peaks: ``python -m tests.benchmarks.attack_peaks --loops 200``.

Drawn sampled loops, each certified, are attacked by an evolution of arrivals: a simulation in closed form
that knows samples, losses and delays, but nothing of the certificate's graph, steps or matrices. No attack
may exceed what is certified.
"""

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servobench.design.delay.delay_loop import speed_model
from servobench.design.sampled.analysis import analyse_loop, with_peak
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from tests.motors import LING

Array = NDArray[np.float64]
_POPULATION, _PARENTS, _GENERATIONS = 192, 24, 25
_INSTANTS = 6


@dataclass(frozen=True)
class DrawnLoop:
    """A drawn current loop, controller and network."""

    strategy: str
    period_s: float
    losses_max: int
    delay_max_s: float
    agreed_s: float
    bandwidth_hz: float
    gains: tuple[float, ...]

    def loop(self) -> HeldLoop:
        """Return the loop as the certificate knows it."""
        network = SampledNetwork(
            Strategy(self.strategy), self.period_s, self.losses_max, self.delay_max_s, self.agreed_s
        )
        model = speed_model(LING, len(self.gains) == 3, self.bandwidth_hz)
        return HeldLoop(model, np.array(self.gains), network)


def drawn_loop(draw: np.random.Generator) -> DrawnLoop:
    """Draw a loop, stable or not, with or without an integral."""
    strategy = ("arrival", "stamp", "history")[int(draw.integers(3))]
    period_s = float(np.exp(draw.uniform(np.log(0.0005), np.log(0.01))))
    bandwidth_hz = float(np.exp(draw.uniform(np.log(30.0), np.log(800.0))))
    losses_max, delay_s = int(draw.integers(0, 4)), period_s * float(draw.uniform(0.0, 1.5))
    agreed_s, age_s = 0.0, (losses_max + 1) * period_s + delay_s
    if strategy != "arrival":
        agreed_s = delay_s + (losses_max * period_s if strategy == "history" else 0.0)
        agreed_s += period_s * float(draw.choice([0.0, draw.uniform(0.0, 1.0)]))
        age_s = agreed_s + period_s * (losses_max + 1 if strategy == "stamp" else 1)
    crossing_rad_s = float(draw.uniform(0.05, 0.6)) / (age_s + 1.0 / (6.3 * bandwidth_hz))
    speed = -crossing_rad_s * LING.inertia_kg_m2 / LING.torque_constant_nm_a
    gains: tuple[float, ...] = (float(draw.uniform(-0.3, 0.1)), speed)
    if draw.integers(2):
        gains += (speed * crossing_rad_s * float(draw.uniform(0.05, 0.35)),)
    return DrawnLoop(strategy, period_s, losses_max, delay_s, agreed_s, bandwidth_hz, gains)


@dataclass
class _Arrivals:
    """Of each individual (P, ..): delay and loss of every sample, and the load's begin before the first."""

    delay_s: Array
    lost: NDArray[np.bool_]
    begun_s: Array

    def part(self, which: NDArray[np.int64]) -> "_Arrivals":
        return _Arrivals(self.delay_s[which], self.lost[which], self.begun_s[which])


def attack(drawn: DrawnLoop, draw: np.random.Generator) -> float:
    """Return the largest speed error that an evolution of arrivals reaches after a load of 1 N m, rad/s."""
    age_s = drawn.agreed_s + drawn.delay_max_s + (drawn.losses_max + 1) * drawn.period_s
    crossing_rad_s = -drawn.gains[1] * LING.torque_constant_nm_a / LING.inertia_kg_m2
    samples = int(min(max(40, 8 * age_s / drawn.period_s, 5.0 / crossing_rad_s / drawn.period_s), 200))
    shape = (_POPULATION, samples)
    people = _Arrivals(
        drawn.delay_max_s * draw.choice([0.0, 1.0, 0.5], size=shape),
        draw.uniform(size=shape) < draw.uniform(size=(_POPULATION, 1)),
        drawn.period_s * draw.choice([1e-9, 0.5, 1.0], size=_POPULATION),
    )
    people.lost[0], people.delay_s[0] = True, drawn.delay_max_s
    best = 0.0
    for _ in range(_GENERATIONS):
        _admissible(people.lost, drawn.losses_max)
        peaks = _simulated(drawn, people)
        best = max(best, float(peaks.max()))
        parents = people.part(np.argsort(-peaks)[:_PARENTS])
        people = _children(drawn, parents, draw)
    return best


def _admissible(lost: NDArray[np.bool_], losses_max: int) -> None:
    """Deliver every sample after ``losses_max`` lost in a row."""
    run = np.zeros(len(lost), dtype=int)
    for sample in range(lost.shape[1]):
        lost[:, sample] &= run < losses_max
        run = np.where(lost[:, sample], run + 1, 0)


def _children(drawn: DrawnLoop, parents: _Arrivals, draw: np.random.Generator) -> _Arrivals:
    """Return the parents themselves, and children crossed and changed in a few samples."""
    count, samples = _POPULATION, parents.lost.shape[1]
    one, other = draw.integers(_PARENTS, size=(2, count))
    cut = draw.integers(samples + 1, size=(count, 1))
    first = np.arange(samples)[None, :] < cut
    children = parents.part(one)
    second = parents.part(other)
    children.delay_s = np.where(first, children.delay_s, second.delay_s)
    children.lost = np.where(first, children.lost, second.lost)
    rate = draw.choice([0.01, 0.05, 0.2], size=(count, 1))
    delays = drawn.delay_max_s * np.where(
        draw.uniform(size=(count, samples)) < 0.6,
        draw.integers(2, size=(count, samples)),
        draw.uniform(size=(count, samples)),
    )
    children.delay_s = np.where(draw.uniform(size=(count, samples)) < rate, delays, children.delay_s)
    children.lost = children.lost ^ (draw.uniform(size=(count, samples)) < rate)
    begun = drawn.period_s * draw.uniform(1e-9, 1.0, size=count)
    children.begun_s = np.where(draw.uniform(size=count) < 0.2, begun, children.begun_s)
    for name in ("delay_s", "lost", "begun_s"):
        getattr(children, name)[:_PARENTS] = getattr(parents, name)
    return children


def _simulated(drawn: DrawnLoop, people: _Arrivals) -> Array:
    """Return each individual's largest speed error, rad/s."""
    h, count = drawn.period_s, len(people.lost)
    delay_s, lost = people.delay_s, people.lost
    if drawn.strategy != "arrival":
        delay_s = np.full_like(delay_s, drawn.agreed_s)
    if drawn.strategy == "history":
        lost = np.zeros_like(lost)
    samples = lost.shape[1]
    taken = np.arange(samples)[None, :]
    arrives = np.where(lost, np.inf, taken * h + delay_s)
    pending = int(max(drawn.agreed_s, drawn.delay_max_s) / h) + 2
    shaft = _Shaft(drawn, count)
    shaft.advance(people.begun_s, _INSTANTS)
    commands, acting = np.zeros((count, samples)), np.full(count, -1)
    for period in range(samples):
        now = np.full(count, period * h)
        commands[:, period] = shaft.command()
        window = slice(max(0, period - pending), period + 1)
        times = np.where(arrives[:, window] < (period + 1) * h - 1e-12, arrives[:, window], np.inf)
        for _ in range(window.stop - window.start):
            # the earliest arrival first, of two at once the older
            place = np.argmin(times, axis=1)
            at = times[np.arange(count), place]
            times[np.arange(count), place] = np.inf
            sample = place + window.start
            newer = np.isfinite(at) & (sample > acting)
            if not newer.any():
                continue
            shaft.advance(np.where(newer, np.maximum(at - now, 0.0), 0.0), _INSTANTS)
            now = np.where(newer, np.maximum(at, now), now)
            shaft.input = np.where(newer, commands[np.arange(count), sample], shaft.input)
            acting = np.where(newer, sample, acting)
        shaft.advance((period + 1) * h - now, _INSTANTS)
    return shaft.largest


class _Shaft:
    """Current, speed and the speed's integral of each individual, under a load of 1 N m, in closed form."""

    def __init__(self, drawn: DrawnLoop, count: int) -> None:
        self._gains = drawn.gains
        self._a = 2.0 * np.pi * drawn.bandwidth_hz
        self._b = LING.viscous_friction_nm_s / LING.inertia_kg_m2
        self._c = LING.torque_constant_nm_a / LING.inertia_kg_m2
        self._current, self._speed, self._angle = np.zeros((3, count))
        self.input = np.zeros(count)
        self.largest = np.zeros(count)

    def command(self) -> Array:
        """Return the controller's answer to what a sample taken now shows."""
        states = (self._current, self._speed, self._angle)
        return np.asarray(sum(gain * state for gain, state in zip(self._gains, states, strict=False)))

    def advance(self, time_s: Array, instants: int) -> None:
        """Let ``time_s`` pass."""
        for _ in range(instants):
            self._step(time_s / instants)
            self.largest = np.maximum(self.largest, np.abs(self._speed))

    def _step(self, t: Array) -> None:
        a, b, c = self._a, self._b, self._c
        apart, driven = self._current - self.input, c * self.input + 1.0 / LING.inertia_kg_m2
        fast, slow = -np.expm1(-a * t) / a, -np.expm1(-b * t) / b
        across = c * apart / (b - a)
        # e^(-at) - e^(-bt) = b slow - a fast
        self._angle = self._angle + self._speed * slow + driven * (t - slow) / b + across * (fast - slow)
        self._speed = self._speed * np.exp(-b * t) + driven * slow + across * (b * slow - a * fast)
        self._current = self.input + apart * np.exp(-a * t)


def main() -> None:
    """Print each loop's bounds, and how far certified lies above found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--loops", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed to begin with, to go on")
    arguments = parser.parse_args()
    ratios, violations, uncertified = [], 0, 0
    for seed in range(arguments.first, arguments.first + arguments.loops):
        drawn = drawn_loop(np.random.default_rng([40, seed]))
        analysis = analyse_loop(drawn.loop())
        if analysis.refuted or not analysis.decay_certified_per_s:
            uncertified += not analysis.refuted
            continue
        analysis = with_peak(analysis)
        attacked = attack(drawn, np.random.default_rng([41, seed]))
        certified = analysis.peak_certified or np.inf
        ratios.append(certified / max(analysis.peak_found, attacked))
        violations += attacked > certified * (1.0 + 1e-9)
        print(
            f"loop {seed:3} {drawn.strategy:8} found {analysis.peak_found:9.4f}, attacked {attacked:9.4f}, "
            f"certified {certified:9.4f}: {ratios[-1]:.3f}",
            flush=True,
        )
    p50, p95 = np.percentile(ratios, [50, 95])
    print(
        f"{len(ratios)} stable loops attacked ({uncertified} more without a certificate of decay): "
        f"{violations} violations; certified over found median {p50:.3f}, p95 {p95:.3f}, "
        f"worst {max(ratios):.3f}; above 1.10: {sum(ratio > 1.1 for ratio in ratios)}, "
        f"above 2: {sum(ratio > 2.0 for ratio in ratios)}"
    )


if __name__ == "__main__":
    main()
