"""From a sweep to its runs: run k of a campaign is the same whoever runs it, and when.

    run k:  replicate k // points, point k % points
    replicate r:  draw r, seed first_seed + r

Every point of the grid meets the same draws and seeds in the same order, so that two of them can be compared
in pairs, and a campaign that ends early has seen all points equally often. At one point no two runs share a
seed: it alone determines the lost frames, and runs that lose the same frames are not independent.

Adaptive draws that concentrate where runs fail, with weights that correct for it: importance sampling in
rounds.

    round 0      from the distributions of the sweep
    round r + 1  from a proposal fitted to the runs of round r that were nearest to failing, or failed
    the rest     from the last proposal, which stays: only these count for the rate; at least half of all

Draws are looked at as z = Phi^-1(u), each key standard normal, whatever its distribution. A proposal is a
mixture: a share of it is the standard normal itself, so that no weight exceeds one over that share and no
way to fail that the rounds have missed is out of reach; the rest are normal kernels about the chosen runs.
The last proposal does not depend on the runs that it draws, so their weighted failures are independent and
their mean is unbiased [Rubinstein and Kroese, The Cross-Entropy Method, 2004, ch. 3; kernels: Zhang, JASA 91
(1996) 1245].
"""

import hashlib
import itertools
import json
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtr, ndtri
from scipy.stats import norm, qmc

from servobench.drivers.bounded_file import NamedBy, read_toml
from servobench.drivers.errors import BadInput
from servobench.hil.campaign.identity import Identity, SourceFiles, program
from servobench.hil.campaign.sweep_file import (
    RUNS_MAX,
    Adaptive,
    Draw,
    OwnFunctions,
    SweepFile,
    Vary,
    sweep_from,
)
from servobench.hil.campaign.twins import TwinMembers
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.verdict.arguments import checked

Floats = NDArray[np.float64]

ELITE_SHARE: Final = 0.2
"""Share of a round to which the next one is fitted; when this many fail, the rounds have arrived."""
NOMINAL_SHARE: Final = {"failures": 0.1, "boundary": 0.5}
"""Share of the nominal distribution in a proposal, by focus: a proposal about the boundary leaves the region
beyond it to this share."""
_SPREAD: Final = 0.7
"""Width of a kernel relative to the runs it represents. Narrower ones shrink from round to round, and then
the rounds hardly advance."""
_LEAST_DEVIATION: Final = 0.3
"""Least width of a kernel, in standard deviations of a key: about as far as a normal reaches beyond three of
them."""


class Proposal(NamedTuple):
    """Distribution to draw from."""

    nominal_share: float
    centres: Floats
    """(k, keys), centres of the kernels."""
    shares: Floats
    """(k,), shares of the kernels, 1 together."""
    factor: Floats
    """(keys, keys), lower triangular: times its transpose the kernels' covariance."""

    def draw(self, count: int, stream: np.random.Generator) -> Floats:
        """Draw (count, keys) in standard normal space."""
        keys = self.factor.shape[0]
        noise = stream.standard_normal((count, keys))
        nominal = stream.random(count) < self.nominal_share
        kernel = stream.choice(self.shares.size, count, p=self.shares)
        drawn: Floats = np.where(nominal[:, None], noise, self.centres[kernel] + noise @ self.factor.T)
        return drawn

    def weights(self, z: Floats) -> Floats:
        """Return the (n,) density of the sweep's distributions over that of the proposal at ``z``, (n,
        keys)."""
        apart = z[:, None, :] - self.centres
        scaled = np.linalg.solve(self.factor, apart.reshape(-1, z.shape[1]).T).T.reshape(apart.shape)
        with np.errstate(divide="ignore"):
            log_shares = np.log(self.shares)
        log_kernels = logsumexp(log_shares - 0.5 * (scaled**2).sum(axis=2), axis=1)
        log_kernels -= np.log(np.diag(self.factor)).sum()
        log_ratio = log_kernels + 0.5 * (z**2).sum(axis=1)
        share = self.nominal_share
        weights: Floats = np.exp(-np.logaddexp(np.log(share), np.log1p(-share) + log_ratio))
        return weights


def fitted(z: Floats, weights: Floats, guide: Floats, failed: NDArray[np.bool_], focus: str) -> Proposal:
    """Fit a proposal to the runs of a round: (n, keys), (n,), (n,), (n,); ``guide``: the larger, the nearer
    to failing."""
    order = np.lexsort((guide, failed))
    count, fails = max(z.shape[1] + 2, round(ELITE_SHARE * len(z))), int(failed.sum())
    if focus == "boundary" and fails:
        passes = len(z) - fails
        chosen = order[max(0, passes - count // 2) : passes + count // 2]
    else:
        chosen = order[-max(count, fails) :]
    shares = np.sqrt(weights[chosen])  # half way to them alone, of which one often outweighs all others
    shares /= shares.sum()
    centres = z[chosen]
    apart = centres - shares @ centres
    covariance = (shares[:, None] * apart).T @ apart
    floor = np.eye(z.shape[1]) * _LEAST_DEVIATION**2
    factor = np.asarray(np.linalg.cholesky(_SPREAD**2 * covariance + floor), np.float64)
    return Proposal(NOMINAL_SHARE[focus], centres, shares, factor)


class Drawn(NamedTuple):
    """The draw of a run."""

    even: tuple[float, ...]
    """By key, in [0, 1) before its distribution."""
    weight: float
    counts: bool
    """True if it counts for the rate: its proposal preceded all runs that count."""


class Rounds:
    """The draws of a campaign, a function of the sweep and of the earlier rows."""

    def __init__(self, adaptive: Adaptive, nominal: Floats, seed: int) -> None:
        """``nominal``: (runs, keys) even draws of the sweep, of which round 0 takes the first."""
        self._adaptive, self._seed = adaptive, seed
        self._count = len(nominal)
        self._even = nominal[: adaptive.round_runs].copy()
        self._weights = np.ones(len(self._even))
        self._rows: list[tuple[float, bool]] = []
        self._round = 0
        self._first_counting = self._count
        self._begin = 0

    def take(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Take in rows in order of their number; one taken before changes nothing."""
        for row in rows:
            if row["run"] < len(self._rows):
                continue
            guide = row[self._adaptive.guide]
            self._rows.append((np.inf if guide is None else guide, not row["passed"]))
            if len(self._rows) == len(self._even) < self._count:
                self._next_round()

    @property
    def known(self) -> int:
        """Number of runs with known draws."""
        return len(self._even)

    def drawn(self, number: int) -> Drawn:
        """Return the draw of run ``number``, below :attr:`known`."""
        even = tuple(self._even[number].tolist())
        return Drawn(even, float(self._weights[number]), number >= self._first_counting)

    def _next_round(self) -> None:
        last = slice(self._begin, len(self._rows))
        guide = np.array([each[0] for each in self._rows[last]])
        failed = np.array([each[1] for each in self._rows[last]])
        z = _normal(self._even[last])
        proposal = fitted(z, self._weights[last], guide, failed, self._adaptive.focus)
        self._round, self._begin = self._round + 1, len(self._rows)
        arrived = failed.mean() >= ELITE_SHARE or (self._adaptive.focus == "boundary" and failed.any())
        size = self._adaptive.round_runs
        if arrived or self._begin + size > self._count // 2:
            self._first_counting, size = self._begin, self._count - self._begin
        size = min(size, self._count - self._begin)
        drawn = proposal.draw(size, np.random.default_rng([self._seed, self._round]))
        self._even = np.concatenate([self._even, ndtr(drawn)])
        self._weights = np.concatenate([self._weights, proposal.weights(drawn)])


def _normal(even: Floats) -> Floats:
    tiny, near_one = np.finfo(np.float64).tiny, 1.0 - np.finfo(np.float64).epsneg
    normal: Floats = ndtri(np.clip(even, tiny, near_one))
    return normal


Changes = dict[str, Any]


class GridAxis(NamedTuple):
    """One axis of the grid."""

    title: str
    """Its key; the first of several."""
    choices: tuple[Changes, ...]
    labels: tuple[str, ...]
    numbers: tuple[float, ...] | None
    """The values; None if they are no numbers."""


class PlannedRun(NamedTuple):
    """The parameters of one run of a campaign."""

    number: int
    point: int
    replicate: int
    seed: int
    changes: Changes
    """Changes of the bench, without the seed."""
    labels: dict[str, float | str]
    """Varied values, for tables: numbers as they are, everything else by its label."""
    weight: float = 1.0
    """Weight of its draw, if draws are adaptive."""
    counts: bool = True
    """True if it counts for the rate."""


class CampaignPlan:
    """All runs of a sweep."""

    def __init__(self, sweep: SweepFile, source: Path, files: SourceFiles | None = None) -> None:
        """``source``: the sweep file; ``files``: known digests of it and its files.

        Raises BadInput or BadInputs: the bench, a key that it lacks, a file that has changed.
        """
        self.sweep = sweep
        self.source = source.absolute()
        """Absolute, independent of later changes of the working directory."""
        self.files = files or SourceFiles(self.source)
        with self.files.noting():
            self._read(sweep, self.source)

    def _read(self, sweep: SweepFile, source: Path) -> None:
        self.own = OwnFunctions(sweep.own, source)
        self.axes = tuple(_axis(vary) for vary in sweep.vary)
        self._points = list(itertools.product(*(range(len(axis.choices)) for axis in self.axes)))
        self.points = len(self._points)
        """Number of grid points."""
        self.count = self.points * sweep.campaign.seeds
        """Number of runs, unless something ends it early."""
        if self.count > RUNS_MAX:
            raise BadInput(str(source), "campaign", f"{self.count} runs", f"at most {RUNS_MAX}")
        path = source.parent / sweep.campaign.bench
        tables = read_toml(path, "bench file", NamedBy(str(source), "campaign.bench", sweep.campaign.bench))
        self.bench = Bench(tables, source=str(path), folder=path.parent).changed(sweep.change)
        refuse_real_time(self.bench.config, str(path))
        self._twins = tuple(
            TwinMembers(source.parent / twin.file, NamedBy(str(source), f"twin.{place}.file", twin.file))
            for place, twin in enumerate(sweep.twin)
        )
        adaptive = sweep.adaptive
        self.rounds = None if adaptive is None else Rounds(adaptive, self._even, sweep.drawing.seed)
        """Rounds of adaptive draws; to be given the rows in order."""
        self._check_choices()

    @classmethod
    def load(cls, path: Path, identity: Identity | None = None) -> "CampaignPlan":
        """Load the sweep file at ``path``; ``identity``: that of the campaign it must belong to.

        Raises BadInput or BadInputs.
        """
        files = SourceFiles(path, None if identity is None else identity["files"])
        with files.noting():
            sweep = sweep_from(read_toml(path, "sweep file"), str(path))
        return cls(sweep, path, files)

    @property
    def known(self) -> int:
        """Number of runs with known draws; those of later ones depend on their rows."""
        return self.count if self.rounds is None else self.rounds.known

    @checked
    def drawn(self, number: int) -> Drawn:
        """Return the draw of run ``number``, below :attr:`known`."""
        if self.rounds is not None:
            return self.rounds.drawn(number)
        return Drawn(tuple(self._even[number // self.points].tolist()), 1.0, True)

    @checked
    def run(self, number: int, drawn: Drawn | None = None) -> PlannedRun:
        """Return run ``number``, counted from 0; ``drawn``: result of :meth:`drawn`, if already known."""
        drawn = drawn or self.drawn(number)
        replicate, point = divmod(number, self.points)
        seed = self.sweep.campaign.first_seed + replicate
        changes: Changes = self.own.changes(seed)
        labels: dict[str, float | str] = {}
        for axis, place in zip(self.axes, self._points[point], strict=True):
            changes |= axis.choices[place]
            labels[axis.title] = axis.labels[place] if axis.numbers is None else axis.numbers[place]
        evens = iter(drawn.even)
        for each in self.sweep.draw:
            value = _spread(each, next(evens))
            changes[each.key] = round(value) if each.whole else value
            labels[each.key] = float(changes[each.key])
        for twin, members in zip(self.sweep.twin, self._twins, strict=True):
            normal = _normal(np.array([next(evens) for _ in members.names]))
            changes[twin.key], values = members.member(normal.tolist())
            labels |= {f"{twin.key}.{name}": value for name, value in values.items()}
        return PlannedRun(number, point, replicate, seed, changes, labels, drawn.weight, drawn.counts)

    @checked
    def point_title(self, point: int) -> str:
        """Describe a point of the grid; empty if there is only one."""
        labels = self.run(point).labels
        shown = {axis.title: labels[axis.title] for axis in self.axes}
        return ", ".join(
            f"{key} = {value if isinstance(value, str) else format(value, 'g')}"
            for key, value in shown.items()
        )

    @property
    def identity(self) -> Identity:
        """Content that its rows depend on, for the files opened so far: a resumed campaign must match it."""
        return {"sweep": self._sweep_digest, "program": dict(program()), "files": dict(self.files.digests)}

    def require(self, identity: Identity) -> None:
        """Raise BadInput if the sweep, or a file opened by runs, differs from ``identity``."""
        self.files.require(identity["files"])
        if identity["sweep"] != self._sweep_digest:
            expected = "the sweep as it was when the campaign began"
            raise BadInput(str(self.source), "", f"BLAKE2b {self._sweep_digest}", expected)

    @cached_property
    def _sweep_digest(self) -> str:
        said = json.dumps(self.sweep.model_dump(mode="json"), sort_keys=True)
        return hashlib.blake2b(said.encode(), digest_size=16).hexdigest()

    def _check_choices(self) -> None:
        """Check each choice, the others at their first: no unknown key, no value out of range."""
        first = self.run(0).changes
        for choice in [choice for axis in self.axes for choice in axis.choices] or [{}]:
            _ = self.bench.changed({**first, **choice}).config

    @cached_property
    def _even(self) -> NDArray[np.float64]:
        """(replicates, keys) in [0, 1), before their distributions."""
        drawing, count = self.sweep.drawing, self.sweep.campaign.seeds
        keys = len(self.sweep.draw) + sum(len(members.names) for members in self._twins)
        if not keys:
            return np.empty((count, 0))
        stream = np.random.default_rng(drawing.seed)
        if drawing.method == "random":
            return stream.random((count, keys))
        if drawing.method == "sobol":
            return np.asarray(qmc.Sobol(keys, scramble=True, rng=stream).random(count))
        return np.asarray(qmc.LatinHypercube(keys, rng=stream).random(count))


def _spread(draw: Draw, even: float) -> float:
    """Map an even value in [0, 1) to the distribution."""
    if draw.distribution == "normal":
        tiny = np.finfo(np.float64).tiny  # Sobol points may be 0, whose quantile is -infinity
        return float(norm.ppf(max(even, tiny), draw.mean, draw.deviation))
    low, high = draw.low or 0.0, draw.high or 0.0
    if draw.distribution == "uniform":
        return low + (high - low) * even
    return float(low * (high / low) ** even)


def _axis(vary: Vary) -> GridAxis:
    keys = vary.keys or (vary.key or "",)
    rows = vary.rows or tuple((value,) for value in vary.values or _range(vary))
    choices = tuple(dict(zip(keys, row, strict=True)) for row in rows)
    plain = all(len(row) == 1 and type(row[0]) in (int, float) for row in rows)
    numbers = tuple(float(row[0]) for row in rows) if plain and not vary.labels else None
    labels = vary.labels or tuple(", ".join(_label(value) for value in row) for row in rows)
    return GridAxis(keys[0], choices, labels, numbers)


def _range(vary: Vary) -> tuple[float | int, ...]:
    assert vary.start is not None
    assert vary.to is not None
    spread = np.geomspace if vary.spacing == "log" else np.linspace
    values = spread(vary.start, vary.to, vary.count or 2).tolist()
    return tuple(round(value) for value in values) if vary.whole else tuple(values)


def _label(value: Any) -> str:
    if isinstance(value, Mapping):
        return str(value.get("kind") or value.get("plan") or json.dumps(value, sort_keys=True))
    return Path(value).stem if isinstance(value, str) else json.dumps(value)


def refuse_real_time(config: BenchConfig, source: str) -> None:
    """Raise BadInput for a bench on a bus in real time, whose drives may be real."""
    spec = config.bus.spec
    if spec != "simulated":
        raise BadInput(source, "bus.spec", spec, "'simulated': a campaign runs in simulated time")
