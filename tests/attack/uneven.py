"""Largest gain that a search reaches in files for uneven SYNCs: ``python -m tests.attack.uneven FILE...``

Numpy alone, apart from all of the design: drive, shaft, links and controller are stepped on a grid of times.
An evolution chooses the distance of every SYNC, which readings are lost, and how long each takes until it
acts; the load is the worst for these, by power iteration on the simulation and its adjoint. Nothing above the
certified gain may be found.
"""

import argparse
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.attack.simulation import exponential

Array = NDArray[np.float64]
STEP_US = 20
PERIODS, POPULATION, PARENTS = 48, 24, 6
ROUNDS = 5
"""Of power iteration: fewer find less, never more."""


class Attacked:
    """A loop stepped by :data:`STEP_US`: x of the plant, then what sampling and acting may change."""

    def __init__(self, controller: dict[str, Any]) -> None:
        made, plant = controller["made_for"], controller["made_for"]["plant"]
        inertia, friction = plant["inertia_kg_m2"], plant["viscous_friction_nm_s"]
        rate = 2.0 * math.pi * made["current_loop"]["bandwidth_hz"]
        self.period, self.within = made["period_us"] // STEP_US, made["sync_within_us"] // STEP_US
        self.losses, self.delay = made["losses_in_a_row_max"], made["delay_max_us"] // STEP_US
        self.static = controller["kind"] == "state_feedback"
        if self.static:
            constant, self.K = plant["torque_constant_nm_a"], np.array(controller["gain"])
            n = len(self.K)
            rates = np.zeros((n + 2, n + 2))
            rates[0, [0, n]] = -rate, rate
            rates[1, [0, 1, n + 1]] = constant / inertia, -friction / inertia, -1.0 / inertia
            if n == 3:
                rates[2, 1] = 1.0
        else:
            self.m = {key: np.array(controller[key]) for key in "ABLCD"}
            proof, n = controller["certificate"], 3
            corner = 2.0 * math.pi * proof["speed_filter_hz"]
            rates = np.zeros((5, 5))
            rates[0, [0, 3]] = -rate, rate
            rates[1, [0, 1, 4]] = 1.0 / inertia, -friction / inertia, -1.0 / inertia
            rates[2, [1, 2]] = corner, -corner
            whole = made["delay_max_us"] + round(proof["dead_time_us"])
            self.behind, self.offset = divmod(whole, made["period_us"])
            self.offset //= STEP_US
        self.n = n
        whole = exponential(rates * STEP_US * 1e-6)
        self.A, self.B, self.E = whole[:n, :n], whole[:n, n], whole[:n, n + 1]

    def drawn(self, draw: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
        """Return (count, PERIODS) steps that each period is longer, losses, and delays in steps."""
        shape = count, PERIODS
        longer = draw.choice([-self.within, 0, self.within], shape).astype(float)
        return (
            longer,
            (draw.random(shape) < 0.5).astype(float),
            draw.choice([0, self.delay], shape).astype(float),
        )

    def events(self, genes: tuple[Array, Array, Array], row: int) -> list[tuple[int, int]]:
        """Return (step, sample) of every act of one run: the sample that acts from that step on."""
        longer, lost, delays = (each[row] for each in genes)
        begins = np.concatenate(([0], np.cumsum(self.period + longer))).astype(int)
        acts, missing = [], 0
        for place in range(PERIODS):
            missing = missing + 1 if lost[place] and missing < self.losses else 0
            if not missing:
                acts.append((int(begins[place] + delays[place]), place))
        newest, events = -1, []
        for at, place in sorted(acts):
            if place > newest:
                newest = place
                events.append((at, place))
        return events

    def begins(self, genes: tuple[Array, Array, Array], row: int) -> Array:
        """Return the step at which each sample is taken, and the end."""
        return np.concatenate(([0], np.cumsum(self.period + genes[0][row]))).astype(int)

    def jumps(self, genes: tuple[Array, Array, Array], row: int) -> tuple[dict[int, list[Array]], int, int]:
        """Return by step the maps of the whole state, in order, the number of steps, and the state's size."""
        return self._static_jumps(genes, row) if self.static else self._dynamic_jumps(genes, row)

    def _static_jumps(
        self, genes: tuple[Array, Array, Array], row: int
    ) -> tuple[dict[int, list[Array]], int, int]:
        """State: x, u, and the last samples' commands."""
        begins, kept = self.begins(genes, row), 3 + self.delay // (self.period - self.within)
        size = self.n + 1 + kept
        found: dict[int, list[Array]] = {}
        for place in range(PERIODS):
            jump = np.eye(size)
            jump[self.n + 1 + place % kept] = 0.0
            jump[self.n + 1 + place % kept, : self.n] = self.K
            found.setdefault(int(begins[place]), []).append(jump)
        for at, place in self.events(genes, row):
            jump = np.eye(size)
            jump[self.n] = np.eye(size)[self.n + 1 + place % kept]
            found.setdefault(at, []).append(jump)
        return found, int(begins[-1]), size

    def _dynamic_jumps(
        self, genes: tuple[Array, Array, Array], row: int
    ) -> tuple[dict[int, list[Array]], int, int]:
        """State: x, u, the held error, the controller's, and commands on their way."""
        begins, lost = self.begins(genes, row), genes[1][row]
        n, order, kept = self.n, len(self.m["C"]), self.behind + 2
        held, state, sent = n + 1, n + 2, n + 2 + order
        size, missing = sent + kept, 0
        found: dict[int, list[Array]] = {}
        for place in range(PERIODS):
            missing = missing + 1 if lost[place] and missing < self.losses else 0
            jump, unit = np.eye(size), np.eye(size)
            jump[held] = unit[held] if missing else -unit[2]
            command = self.m["C"] @ unit[state:sent] + self.m["D"] * jump[held]
            jump[sent + place % kept] = command
            jump[state:sent] = (
                self.m["A"] @ unit[state:sent]
                + np.outer(self.m["B"], jump[held])
                + np.outer(self.m["L"], command)
            )
            found.setdefault(int(begins[place]), []).append(jump)
            if place >= self.behind:
                acting = np.eye(size)
                acting[n] = np.eye(size)[sent + (place - self.behind) % kept]
                found.setdefault(int(begins[place] + self.offset), []).append(acting)
        return found, int(begins[-1]), size

    def gain(self, genes: tuple[Array, Array, Array], row: int, draw: np.random.Generator) -> float:
        """Return the largest ratio of error to load found, both in L2, from rest, rad/s per N m."""
        jumps, steps, size = self.jumps(genes, row)
        whole = np.eye(size)
        whole[: self.n, : self.n], whole[: self.n, self.n] = self.A, self.B
        load, best = draw.standard_normal(steps), 0.0
        for _ in range(ROUNDS):
            load /= np.linalg.norm(load)
            x, errors = np.zeros(size), np.zeros(steps)
            for at in range(steps):
                for jump in jumps.get(at, ()):
                    x = jump @ x
                x = whole @ x
                x[: self.n] += self.E * load[at]
                errors[at] = x[1]
            best = max(best, float(np.linalg.norm(errors)))
            back, load = np.zeros(size), np.zeros(steps)
            for at in range(steps - 1, -1, -1):
                back[1] += errors[at]
                load[at] = self.E @ back[: self.n]
                back = whole.T @ back
                for jump in reversed(jumps.get(at, ())):
                    back = jump.T @ back
        return best


def attack(controller: dict[str, Any], seed: int, generations: int) -> float:
    """Return the largest gain found."""
    loop, draw = Attacked(controller), np.random.default_rng(seed)
    genes, best = loop.drawn(draw, POPULATION), 0.0
    for generation in range(generations):
        lengths = draw.integers(1, 9, POPULATION)  # a run repeats its first periods: such are the worst
        for row, length in enumerate(lengths):
            if generation == 0 or row >= PARENTS:
                for each in genes:
                    each[row] = np.resize(each[row, :length], PERIODS)
        scores = np.array([loop.gain(genes, row, draw) for row in range(POPULATION)])
        best = max(best, float(scores.max()))
        order = np.argsort(-scores)[:PARENTS]
        fresh = loop.drawn(draw, POPULATION)
        parents = order[draw.integers(0, PARENTS, POPULATION)]
        for each, new in zip(genes, fresh, strict=True):
            kept, changed = each[order], draw.random(each.shape) < 0.15
            each[:] = np.where(changed, new, each[parents])
            each[:PARENTS] = kept
    return best


def main() -> None:
    """Print certified and found of each file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--generations", type=int, default=10)
    asked = parser.parse_args()
    for path in asked.files:
        controller = tomllib.loads(path.read_text(encoding="utf-8"))["controller"]
        certified = controller["certificate"]["sequences"]["gain_certified"]
        found = attack(controller, asked.seed, asked.generations)
        verdict = "EXCEEDED" if found > certified else "not exceeded"
        print(
            f"{path.name}: certified {certified:.4f}, found {found:.4f}, {certified / found:.3f}: {verdict}"
        )


if __name__ == "__main__":
    main()
