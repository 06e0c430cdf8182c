"""Random losses: the analysis beside runs by chance: ``python -m tests.benchmarks.bench_random_losses``.

The runs share nothing with the analysis. Shaft, drive and links are simulated step by step, the controllers
compute what the host computes: a filter, a prediction over the commands on their way, a feedback. The
predictor's filter takes readings for steps of the load by their innovation, as it does on the bench.
"""

import argparse
import math
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from servobench.design.confidence import clopper_pearson
from servobench.hil.configuration.bench_file import load_controller
from servobench.hil.configuration.network_file import LossChain, Network
from servobench.hil.studies.speed.random_losses import Designed, losses_figures, losses_of

Array = NDArray[np.float64]
FILES = tuple(
    Path(f"examples/controllers/ling2012-{kind}.toml") for kind in ("static", "predictor", "fused", "hinf")
)
WITHIN, SIGMAS = 16, 1.959964
LOAD_NM = 0.6
BEFORE = 20
"""Periods before the load step, at rest: what was lost then, a filter's gains know."""
MULTIPLES = (1.1, 1.25, 1.5)
"""Thresholds, in peaks without losses."""


class Link(NamedTuple):
    """p good to bad, p bad to good, losses in the bad and in the good state."""

    up: float = 0.0
    down: float = 1.0
    bad: float = 0.0
    good: float = 0.0


NETWORKS = {
    "5 % of readings": (Link(good=0.05), Link()),
    "20 % of readings": (Link(good=0.2), Link()),
    "10 % both ways": (Link(good=0.1), Link(good=0.1)),
    "bursts of 2, 4 %": (Link(0.02, 0.5, 1.0), Link()),
    "bursts both ways": (Link(0.03, 0.6, 0.8, 0.01), Link(0.02, 0.6, 0.9)),
}


def network_of(links: tuple[Link, Link]) -> Network:
    chains = [LossChain(**dict(zip(LossChain.model_fields, link, strict=True))) for link in links]
    return Network(
        period_us=1000,
        losses_in_a_row_max=5,
        delay_max_us=1000,
        reading_losses=chains[0],
        command_losses=chains[1],
    )


def fates(link: Link, runs: int, draw: np.random.Generator) -> Iterator[NDArray[np.bool_]]:
    """Yield for each period which of the runs lose their frame."""
    share = link.up / (link.up + link.down)
    bad = draw.random(runs) < share
    while True:
        bad = np.where(bad, draw.random(runs) >= link.down, draw.random(runs) < link.up)
        yield draw.random(runs) < np.where(bad, link.bad, link.good)


class Physics:
    """[T, omega, filtered, angle] under a command and a load."""

    def __init__(self, inertia: float, friction: float, rate: float, corner: float) -> None:
        self._rates = np.zeros((6, 6))
        self._rates[0, [0, 4]] = -rate, rate
        self._rates[1, [0, 1, 5]] = 1.0 / inertia, -friction / inertia, -1.0 / inertia
        self._rates[2, [1, 2]] = corner, -corner
        self._rates[3, 1] = 1.0
        self._known: dict[float, Array] = {}

    def run(self, x: Array, command: Array, load: Array, length_s: float) -> Array:
        if length_s not in self._known:
            self._known[length_s] = scipy.linalg.expm(self._rates * length_s)
        return np.column_stack([x, command, load]) @ self._known[length_s][:4].T


class Host:
    """A controller of ``file`` in many runs; ``sent``: its commands, the newest first."""

    def __init__(self, file: dict[str, Any], runs: int) -> None:
        made = file["made_for"]
        self.kind, self._file = file["kind"], file
        self.period_s = made["period_us"] * 1e-6
        delay_s = made["delay_max_us"] * 1e-6
        drive = file["certificate"] if self.kind == "hinf" else file
        delay_s += drive.get("dead_time_us", 0.0) * 1e-6
        self.behind = int(delay_s / self.period_s + 1e-9)
        self.acts_s = delay_s - self.behind * self.period_s
        plant, hz = made["plant"], made["current_loop"]["bandwidth_hz"]
        shaft = plant["inertia_kg_m2"], plant["viscous_friction_nm_s"]
        corner = math.tau * drive.get("speed_filter_hz", 500.0)
        self.plant = Physics(*shaft, math.tau * hz, corner)
        self.constant = plant["torque_constant_nm_a"]
        self.sent = [np.zeros(runs) for _ in range(self.behind + 2)]
        self.x, self.load = np.zeros((runs, 4)), np.zeros(runs)
        self.lost = np.zeros(runs, dtype=int)
        if self.kind == "hinf":
            self.state, self.error = np.zeros((runs, len(file["C"]))), np.zeros(runs)
        if self.kind == "predictor":
            self._begin_filter(runs, shaft, corner)

    def decide(self, truth: Array, missing: NDArray[np.bool_]) -> None:
        """Take the readings that came, and compute a command each."""
        command = getattr(self, f"_{self.kind}")(truth, missing)
        self.sent = [command, *self.sent[:-1]]

    def follow(self) -> None:
        """Move the estimate to the next sample, as if every command acted."""
        self.x = self.plant.run(self.x, self.sent[self.behind + 1], self.load, self.acts_s)
        self.x = self.plant.run(self.x, self.sent[self.behind], self.load, self.period_s - self.acts_s)

    def _state_feedback(self, truth: Array, missing: NDArray[np.bool_]) -> Array:  # noqa: ARG002
        gains = [*self._file["gain"], 0.0]
        speed = gains[1] * truth[:, 1] + gains[2] * truth[:, 3]
        return np.asarray(gains[0] * truth[:, 0] + self.constant * speed)

    def _hinf(self, truth: Array, missing: NDArray[np.bool_]) -> Array:
        states, inputs, of_sent, out = (np.array(self._file[key]) for key in "ABLC")
        self.error = np.where(missing, self.error, -truth[:, 2])
        command = self.state @ out + self._file["D"] * self.error
        self.state = self.state @ states.T + np.outer(self.error, inputs) + np.outer(command, of_sent)
        return np.asarray(command)

    def _fused(self, truth: Array, missing: NDArray[np.bool_]) -> Array:
        tables = np.array(self._file["gains"])
        gains = tables[np.minimum(self.lost, len(tables) - 1)]
        told = np.stack([truth[:, 3] - self.x[:, 3], truth[:, 2] - self.x[:, 2]], axis=1)
        added = np.einsum("rij,rj->ri", gains, told)
        added[missing] = 0.0
        self.x[:, 1:] += added[:, :3]
        self.load = self.load + added[:, 3]
        self.lost = np.where(missing, self.lost + 1, 0)
        return self._ahead()

    def _begin_filter(self, runs: int, shaft: tuple[float, float], corner: float) -> None:
        inertia, friction = shaft
        rates = np.array(
            [[-friction / inertia, 0.0, -1.0 / inertia], [corner, -corner, 0.0], [0.0, 0.0, 0.0]]
        )
        self._Phi = scipy.linalg.expm(rates * self.period_s)
        ticks = np.linspace(0.0, self.period_s, 2001)
        after = np.array([scipy.linalg.expm(rates * t)[:, 2] for t in ticks])
        spread = np.trapezoid(after[:, :, None] * after[:, None, :], ticks, axis=0)
        held = -self._file["torque_noise_nm"] * np.append(self._Phi[:2, 2], 0.0)
        self._Q = [
            np.outer(held, held) + self._file[key] ** 2 * spread
            for key in ("load_noise_nm_sqrt_s", "load_noise_max_nm_sqrt_s")
        ]
        self._R = self._file["speed_noise_rad_s"] ** 2
        self._P = []
        for added in self._Q:
            settled = np.eye(3)[None]
            for _ in range(3000):
                settled = self._corrected(self._Phi @ settled @ self._Phi.T + added)
            self._P.append(np.repeat(settled, runs, axis=0))

    def _corrected(self, spread: Array) -> Array:
        told = (spread[:, 1, 1] + self._R)[:, None, None]
        return np.asarray(spread - spread[:, :, 1:2] * spread[:, 1:2, :] / told)

    def _predictor(self, truth: Array, missing: NDArray[np.bool_]) -> Array:
        quiet, bold = (self._Phi @ P @ self._Phi.T + Q for P, Q in zip(self._P, self._Q, strict=True))
        told = truth[:, 2] - self.x[:, 2]
        step = told**2 > 1.5**2 * (quiet[:, 1, 1] + self._R)
        taken = np.where(step[:, None, None], bold, quiet)
        came = ~missing
        gain = taken[:, :, 1] / (taken[:, 1, 1] + self._R)[:, None]
        added = np.where(came[:, None], gain * told[:, None], 0.0)
        self.x[:, 1:3] += added[:, :2]
        self.load = self.load + added[:, 2]
        self._P = [
            np.where(came[:, None, None], self._corrected(spread), before)
            for spread, before in ((taken, quiet), (bold, bold))
        ]
        return self._ahead()

    def _ahead(self) -> Array:
        """Return the command for the state at the instant at which it acts."""
        x = self.plant.run(self.x, self.sent[self.behind], self.load, self.acts_s)
        for place in range(self.behind - 1, -1, -1):
            x = self.plant.run(x, self.sent[place], self.load, self.period_s)
        torque, speed = self._file["torque_gain"], self._file["speed_gain_nm_s_rad"]
        return np.asarray(self.load * (1.0 + torque) - torque * x[:, 0] - speed * x[:, 1])


def errors(path: Path, links: tuple[Link, Link], runs: int, periods: int, seed: int) -> tuple[Array, Array]:
    """Return (runs, periods) speeds at the end of each after a load step just after a sample, and (runs,) the
    largest magnitudes at the instants within."""
    draw = np.random.default_rng(seed)
    host = Host(tomllib.loads(path.read_text(encoding="utf-8"))["controller"], runs)
    readings, commands = (fates(link, runs, draw) for link in links)
    x, force = np.zeros((runs, 4)), np.zeros(runs)
    h = host.period_s
    instants = sorted({h * part / WITHIN for part in range(1, WITHIN + 1)} | {host.acts_s})
    ends, peaks = [], np.zeros(runs)
    for number in range(-BEFORE, periods):
        missing, unheard = next(readings), next(commands)
        if host.kind == "state_feedback":
            unheard = unheard | missing
        host.decide(x, missing)
        acting, at_s = np.where(unheard, force, host.sent[host.behind]), 0.0
        host.follow()
        load = np.full(runs, LOAD_NM if number >= 0 else 0.0)
        if host.acts_s == 0.0:
            force = acting
        for instant in instants:
            x = host.plant.run(x, force, load, instant - at_s)
            at_s = instant
            if instant == host.acts_s:
                force = acting
            if number >= 0 and any(abs(instant - h * part / WITHIN) < 1e-12 for part in range(1, WITHIN + 1)):
                peaks = np.maximum(peaks, np.abs(x[:, 1]))
        if number >= 0:
            ends.append(x[:, 1].copy())
    return np.array(ends).T, peaks


class Beside(NamedTuple):
    """A figure of the analysis beside that of the runs, with its interval."""

    name: str
    least: float
    most: float
    seen: float
    low: float
    high: float

    @property
    def inside(self) -> bool:
        """True if the interval meets what the analysis allows."""
        return self.low <= self.most and self.high >= self.least


def beside(
    path: Path,
    links: tuple[Link, Link],
    runs: int,
    seed: int,
    periods: int = 60,
    multiples: Sequence[float] = MULTIPLES,
) -> list[Beside]:
    """Return variance where it is largest, and exceedances, of the analysis and of runs."""
    controller = load_controller(path)
    assert isinstance(controller, Designed)
    losses = losses_of(network_of(links), path, controller)
    ends, peaks = errors(path, links, runs, periods, seed)
    _, (lossless,) = errors(path, (Link(), Link()), 1, periods, seed)
    thresholds = [multiple * float(lossless) for multiple in multiples]
    figures = losses_figures(controller, path, losses, LOAD_NM, thresholds)
    step = figures["after_step"]
    at = int(np.argmax(step["deviations_rad_s"][:periods]))
    apart = (ends[:, at] - ends[:, at].mean()) ** 2
    error = SIGMAS * float(apart.std()) / math.sqrt(runs)
    variance, seen = step["deviations_rad_s"][at] ** 2, float(apart.mean())
    found = [Beside("variance", variance, variance, seen, seen - error, seen + error)]
    for threshold, bound in zip(thresholds, figures["exceedance"], strict=True):
        events = int((peaks > threshold).sum())
        interval = clopper_pearson(events, runs)
        least, most = bound["probability_least"], bound["probability_most"]
        found.append(Beside(f"above {threshold:.3f} rad/s", least, most, events / runs, *interval))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=40)
    asked = parser.parse_args()
    outside = 0
    for path in FILES:
        for number, (name, links) in enumerate(NETWORKS.items()):
            print(f"{path.stem}, {name}", flush=True)
            seed = asked.seed + 100 * FILES.index(path) + number
            for each in beside(path, links, asked.runs, seed):
                outside += not each.inside
                print(
                    f"  {each.name:<20} {each.least:.6f} .. {each.most:.6f}   seen {each.seen:.6f}"
                    f" ({each.low:.6f} .. {each.high:.6f}){'' if each.inside else '   outside'}"
                )
    print(f"outside: {outside}")


if __name__ == "__main__":
    main()
