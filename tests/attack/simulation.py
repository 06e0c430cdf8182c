"""Loops on stdin, one JSON object a line; the largest errors that a search reaches on stdout.

Numpy alone: shaft, drive, links and controllers are simulated here step by step. An evolution chooses which
readings and commands are lost, when each command begins to act, when the load comes within a period, the
shaft's inertia, and which readings a predictor takes for steps of the load.
"""

import json
import math
import sys
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bits = NDArray[np.bool_]
POPULATION, PARENTS, GENERATIONS = 160, 24, 20
BEFORE = 5
"""Periods at rest before the load: what was lost then, a controller remembers."""
WITHIN = 12
SHAFTS = 7
BEGINS = 5
"""Instants at which a command may begin to act, where its delay varies."""


def exponential(matrix: Array) -> Array:
    """Return e to the power of ``matrix``."""
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(matrix).sum(axis=1).max()), 1e-9))) + 4)
    scaled = matrix / 2.0**halvings
    total, term = np.eye(len(matrix)), np.eye(len(matrix))
    for power in range(1, 14):
        term = term @ scaled / power
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


class Physics:
    """[T, omega, filtered, angle] under a command and a load."""

    def __init__(self, loop: dict[str, Any], heavier: float = 1.0) -> None:
        inertia, friction, rate = heavier * loop["inertia"], loop["friction"], loop["rate"]
        self._rates = np.zeros((6, 6))
        self._rates[0, [0, 4]] = -rate, rate
        self._rates[1, [0, 1, 5]] = 1.0 / inertia, -friction / inertia, -1.0 / inertia
        self._rates[2, [1, 2]] = loop["filter"], -loop["filter"]
        self._rates[3, 1] = 1.0
        self._known: dict[float, Array] = {}

    def run(self, x: Array, command: Array, load: Array, length_s: float) -> Array:
        """Return the states (runs, 4) after ``length_s``."""
        key = round(length_s, 15)
        if key not in self._known:
            self._known[key] = exponential(self._rates * length_s)[:4].T
        return np.column_stack([x, command, load]) @ self._known[key]


class Shafts:
    """The physics of many runs, each with its own multiple of the inertia."""

    def __init__(self, loop: dict[str, Any], heavier: Array) -> None:
        self._own = [(heavier == each, Physics(loop, float(each))) for each in np.unique(heavier)]

    def run(self, x: Array, command: Array, load: Array, length_s: float) -> Array:
        """Return the states (runs, 4) after ``length_s``."""
        after = np.empty_like(x)
        for runs, physics in self._own:
            after[runs] = physics.run(x[runs], command[runs], load[runs], length_s)
        return after


class Host:
    """The controller of ``loop`` in many runs; ``sent``: its commands, the newest first."""

    def __init__(self, loop: dict[str, Any], runs: int) -> None:
        self._loop, self.plant = loop, Physics(loop)
        self.h = loop["period"]
        self.behind = int(loop["delay"] / self.h + 1e-9)
        self.acts_s = max(0.0, loop["delay"] - self.behind * self.h)
        self.sent = [np.zeros(runs) for _ in range(self.behind + 2)]
        self.x, self.load = np.zeros((runs, 4)), np.zeros(runs)
        self.lost = np.zeros(runs, dtype=int)
        kind = loop["kind"]
        self._answer = {
            "static": self._static,
            "hinf": self._hinf,
            "fused": self._fused,
            "predictor": self._predictor,
        }[kind]
        if kind == "hinf":
            self.state, self.error = np.zeros((runs, len(loop["C"]))), np.zeros(runs)
        if kind == "predictor":
            self._settle(runs)

    def decide(self, truth: Array, missing: Bits, bold: Bits) -> None:
        """Take the readings that came, and compute a command each."""
        self.sent = [self._answer(truth, missing, bold), *self.sent[:-1]]
        self.x = self.plant.run(self.x, self.sent[self.behind + 1], self.load, self.acts_s)
        self.x = self.plant.run(self.x, self.sent[self.behind], self.load, self.h - self.acts_s)

    def _static(self, truth: Array, missing: Bits, bold: Bits) -> Array:  # noqa: ARG002
        return np.asarray(self._loop["gains"][0] * truth[:, 0] + self._loop["gains"][1] * truth[:, 1])

    def _hinf(self, truth: Array, missing: Bits, bold: Bits) -> Array:  # noqa: ARG002
        states, inputs, of_sent, out = (np.array(self._loop[key]) for key in "ABLC")
        self.error = np.where(missing, self.error, -truth[:, 2])
        command = self.state @ out + self._loop["D"] * self.error
        self.state = self.state @ states.T + np.outer(self.error, inputs) + np.outer(command, of_sent)
        return np.asarray(command)

    def _fused(self, truth: Array, missing: Bits, bold: Bits) -> Array:  # noqa: ARG002
        tables = np.array(self._loop["gains"])
        told = np.stack([truth[:, 3] - self.x[:, 3], truth[:, 2] - self.x[:, 2]], axis=1)
        added = np.einsum("rij,rj->ri", tables[np.minimum(self.lost, len(tables) - 1)], told)
        added[missing] = 0.0
        self.x[:, 1:] += added[:, :3]
        self.load = self.load + added[:, 3]
        self.lost = np.where(missing, self.lost + 1, 0)
        return self._ahead()

    def _settle(self, runs: int) -> None:
        """Let the covariances of [omega, filtered, load] settle, of both walks."""
        loop = self._loop
        rates = np.zeros((3, 3))
        rates[0, [0, 2]] = -loop["friction"] / loop["inertia"], -1.0 / loop["inertia"]
        rates[1, [0, 1]] = loop["filter"], -loop["filter"]
        self._Phi = exponential(rates * self.h)
        ticks = 2000
        step, at = exponential(rates * (self.h / ticks)), np.array([0.0, 0.0, 1.0])
        spread = np.zeros((3, 3))
        for tick in range(ticks + 1):
            spread += np.outer(at, at) * (0.5 if tick in (0, ticks) else 1.0) * self.h / ticks
            at = step @ at
        held = loop["torque_noise"] * np.array([self._Phi[0, 2], self._Phi[1, 2], 0.0])
        self._Q = [np.outer(held, held) + walk * walk * spread for walk in loop["walks"]]
        self._R = loop["speed_noise"] ** 2
        self._P = []
        for added in self._Q:
            settled = np.eye(3)[None]
            for _ in range(4000):
                settled = self._corrected(self._Phi @ settled @ self._Phi.T + added)
            self._P.append(np.repeat(settled, runs, axis=0))

    def _corrected(self, spread: Array) -> Array:
        told = (spread[:, 1, 1] + self._R)[:, None, None]
        return np.asarray(spread - spread[:, :, 1:2] * spread[:, 1:2, :] / told)

    def _predictor(self, truth: Array, missing: Bits, bold: Bits) -> Array:
        quiet, fast = (self._Phi @ P @ self._Phi.T + Q for P, Q in zip(self._P, self._Q, strict=True))
        taken = np.where(bold[:, None, None], fast, quiet)
        gain = taken[:, :, 1] / (taken[:, 1, 1] + self._R)[:, None]
        came = ~missing
        added = np.where(came[:, None], gain * (truth[:, 2] - self.x[:, 2])[:, None], 0.0)
        self.x[:, 1:3] += added[:, :2]
        self.load = self.load + added[:, 2]
        self._P = [
            np.where(came[:, None, None], self._corrected(spread), before)
            for spread, before in ((taken, quiet), (fast, fast))
        ]
        return self._ahead()

    def _ahead(self) -> Array:
        """Return the command for the state at the instant at which it acts."""
        x = self.plant.run(self.x, self.sent[self.behind], self.load, self.acts_s)
        for place in range(self.behind - 1, -1, -1):
            x = self.plant.run(x, self.sent[place], self.load, self.h)
        torque, speed = self._loop["gains_of_state"]
        return np.asarray(self.load * (1.0 + torque) - torque * x[:, 0] - speed * x[:, 1])


@dataclass
class People:
    """(P, periods) each, ``late`` a number of the instants; (P,) when the load comes, in periods
    after a sample, and shares of the inertia."""

    missing: Bits
    unheard: Bits
    bold: Bits
    late: NDArray[np.int64]
    part: Array
    heavier: Array

    def of(self, which: NDArray[np.int64]) -> "People":
        """Return some of them."""
        return People(*(getattr(self, own.name)[which] for own in fields(self)))


def bounded(lost: Bits, most: int) -> None:
    """Let every frame after ``most`` lost in a row come."""
    run = np.zeros(len(lost), dtype=int)
    for period in range(lost.shape[1]):
        lost[:, period] &= run < most
        run = np.where(lost[:, period], run + 1, 0)


def peaks(loop: dict[str, Any], people: People) -> Array:
    """Return each one's largest error after a load of 1 N m, rad/s."""
    runs, periods = people.missing.shape
    host, shafts = Host(loop, runs), Shafts(loop, people.heavier)
    x, force, peak, h = np.zeros((runs, 4)), np.zeros(runs), np.zeros(runs), host.h
    parts = np.unique(people.part)
    begins = begins_of(loop)
    instants = sorted({h * k / WITHIN for k in range(1, WITHIN + 1)} | set(begins) | set(h * parts))
    instants = [each for each in instants if each > 0.0]
    for number in range(periods):
        missing, unheard = people.missing[:, number], people.unheard[:, number]
        if loop["kind"] == "static":
            unheard = unheard | missing
        host.decide(x, missing, people.bold[:, number])
        acting, at_s = np.where(unheard, force, host.sent[host.behind]), 0.0
        acts_s = begins[people.late[:, number]]
        force = np.where(acts_s == 0.0, acting, force)
        for instant in instants:
            begun = number > BEFORE or (number == BEFORE and np.full(runs, instant) > h * people.part + 1e-12)
            x = shafts.run(x, force, np.where(begun, 1.0, 0.0) * np.ones(runs), instant - at_s)
            at_s = instant
            force = np.where(acts_s == instant, acting, force)
            peak = np.maximum(peak, np.abs(x[:, 1]))
    return peak


def begins_of(loop: dict[str, Any]) -> Array:
    """Return the instants of a period at which its command may begin to act."""
    least, most = (
        max(0.0, each - loop["period"] * int(loop["delay"] / loop["period"] + 1e-9))
        for each in loop["delays"]
    )
    return np.linspace(least, most, 1 if least == most else BEGINS)


def attacked(loop: dict[str, Any]) -> float:
    """Return the largest error that the evolution reaches."""
    draw = np.random.default_rng(loop["seed"])
    behind = loop["delay"] / loop["period"]
    periods = BEFORE + 1 + math.ceil(4.0 * (behind + 1.0)) + 6 * (loop["readings"] + loop["commands"] + 1)
    shape, count = (POPULATION, periods), len(begins_of(loop))
    people = People(
        draw.random(shape) < draw.random((POPULATION, 1)),
        draw.random(shape) < draw.random((POPULATION, 1)),
        draw.random(shape) < draw.random((POPULATION, 1)) * (np.arange(POPULATION) % 3 > 0)[:, None],
        draw.integers(count, size=shape),
        draw.choice([0.0, 0.25, 0.5, 0.75], size=POPULATION),
        draw.choice(inertias(loop), size=POPULATION),
    )
    people.missing[0] = people.unheard[0] = people.bold[0] = False
    people.missing[1], people.bold[1] = True, False
    for place in range(3):
        people.late[place::40] = place * (count - 1) // 2
    best = 0.0
    for _ in range(GENERATIONS):
        bounded(people.missing, loop["readings"])
        bounded(people.unheard, loop["commands"])
        reached = peaks(loop, people)
        best = max(best, float(reached.max()))
        people = children(people.of(np.argsort(-reached)[:PARENTS]), draw, inertias(loop), count)
    return best


def inertias(loop: dict[str, Any]) -> Array:
    """Return those that are tried, both ends among them."""
    least, most = loop["inertias"]
    return np.linspace(least, most, 1 if least == most else SHAFTS)


def children(parents: People, draw: np.random.Generator, shafts: Array, begins: int) -> People:
    """Return the parents themselves, and children crossed and changed in a few periods."""
    one, other = draw.integers(PARENTS, size=(2, POPULATION))
    one[:PARENTS] = other[:PARENTS] = np.arange(PARENTS)
    periods = parents.missing.shape[1]
    first = np.arange(periods)[None, :] < draw.integers(periods + 1, size=(POPULATION, 1))
    mine, yours = parents.of(one), parents.of(other)
    rate = draw.choice([0.02, 0.06, 0.2], size=(POPULATION, 1))
    rate[:PARENTS] = 0.0
    for name in ("missing", "unheard", "bold"):
        crossed = np.where(first, getattr(mine, name), getattr(yours, name))
        setattr(mine, name, crossed ^ (draw.random((POPULATION, periods)) < rate))
    mine.late = np.where(first, mine.late, yours.late)
    changed = draw.random((POPULATION, periods)) < rate
    mine.late = np.where(changed, draw.integers(begins, size=(POPULATION, periods)), mine.late)
    elsewhere = (draw.random(POPULATION) < 0.2) & (rate[:, 0] > 0.0)
    mine.part = np.where(elsewhere, draw.choice([0.0, 0.1, 0.3, 0.6, 0.9], size=POPULATION), mine.part)
    other_shaft = (draw.random(POPULATION) < 0.2) & (rate[:, 0] > 0.0)
    mine.heavier = np.where(other_shaft, draw.choice(shafts, size=POPULATION), mine.heavier)
    return mine


def main() -> None:
    """Answer each line at once."""
    for line in sys.stdin:
        print(json.dumps(attacked(json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
