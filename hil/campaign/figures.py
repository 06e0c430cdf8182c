"""Results of a campaign: rates, quantiles, worst cases, sensitivities, pairs, and the cells of a map over two
axes; plain values.
"""

import math
from collections.abc import Collection
from statistics import NormalDist
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from servobench.hil.campaign.campaign import Campaign, counted
from servobench.hil.campaign.plan import GridAxis
from servobench.hil.campaign.statistics import ConfidenceInterval, Sensitivity, paired, quantile, sensitivity
from servobench.hil.campaign.worker import FIGURES
from servobench.hil.reviewing.certificate_meter import CertificateState

PEAK = "speed_error_peak_percent"
"""The figure shown in heat maps and worst cases."""
WORST_SHOWN = 10
QUANTILES = (0.5, 0.95)


def figures_of(done: Campaign) -> dict[str, Any]:
    """Return the figures for JSON and reports."""
    stop = done.plan.sweep.stop
    kind = "a confidence sequence: it holds whenever one ends" if done.sequential else "Clopper-Pearson"
    if done.adaptive:
        kind = "weighted draws, normal in the logarithm"
    return {
        "name": done.plan.sweep.campaign.name,
        "folder": str(done.folder),
        "planned": done.plan.count,
        "confidence": stop.confidence,
        "interval": kind,
        "runs": done.table.num_rows,
        "passed": int(done.column("passed").sum()),
        "points": [_point(done, number) for number in range(done.plan.points)],
        "outcomes": counted(done.column("outcome")),
        "certificate": _certificate(done),
        "found": {str(number): texts for number, texts in done.found.items()},
        "quantiles": _quantiles(done),
        "sensitivity": _sensitivities(done),
        "worst": worst_runs(done),
        "pairs": _pairs(done),
        **({"failure": _failure(done)} if done.adaptive else {}),
    }


def _failure(done: Campaign) -> dict[str, Any]:
    """Return the failure probability of adaptive draws, and how many plain ones would be as precise."""
    rate = done.failure_rate()
    deviation = (rate.high - rate.low) / (
        2.0 * NormalDist().inv_cdf(0.5 + 0.5 * done.plan.sweep.stop.confidence)
    )
    known = rate.estimate > 0.0 and deviation > 0.0
    return {
        **_plain(rate, "rate"),
        "counting": int(done.column("counts").sum()),
        "plain_runs": round(rate.estimate * (1.0 - rate.estimate) / deviation**2) if known else None,
    }


def _point(done: Campaign, number: int) -> dict[str, Any]:
    labels = done.plan.run(number).labels
    where = done.column("point") == number
    peak = done.column(PEAK).astype(float)[where & done.nominal]
    interval = quantile(peak[np.isfinite(peak)], QUANTILES[-1], done.plan.sweep.stop.confidence)
    return {
        "point": done.plan.point_title(number),
        "keys": {axis.title: labels[axis.title] for axis in done.plan.axes},
        "runs": int(where.sum()),
        "passed": int(done.column("passed")[where].sum()),
        **_plain(done.pass_rate(number), "rate"),
        f"{PEAK}_q95": _plain(interval, "value"),
    }


def failure_line(rates: dict[str, Any]) -> str:
    """Return the same in words."""
    plain = "" if rates["plain_runs"] is None else f"; plain draws would take {rates['plain_runs']} for it"
    rate, low, high = (rates[name] for name in ("rate", "low", "high"))
    shown = "not known" if rate is None else f"{rate:.3g}"
    return (
        f"failure probability {shown}, {low:.3g} to {high:.3g}, by {rates['counting']} weighted runs behind "
        f"those that found the way{plain}"
    )


def _plain(figures: ConfidenceInterval | Sensitivity, estimate: str = "") -> dict[str, float | None]:
    """Remove values that JSON cannot express; ``estimate``: name of an interval's estimate."""
    named = {estimate if key == "estimate" else key: value for key, value in figures._asdict().items()}
    return {key: float(value) if math.isfinite(value) else None for key, value in named.items()}


def _certificate(done: Campaign) -> dict[str, Any]:
    """Count the runs by the state of their controller's certificate, with the nearest approach to it."""
    states = done.column("certificate").astype(str)
    if not (states != "").any():
        return {}
    left = [text for name in ("premises_left", "premises_unknown") for text in done.column(name)]
    names = [part.partition(":")[0] for text in left for part in text.split("; ") if part]
    share = done.column("load_gain_least_rad_s_nm") / done.column("load_gain_certified_rad_s_nm")
    share[(states != CertificateState.KEPT) & (states != CertificateState.EXCEEDED)] = np.nan
    measured = bool(np.isfinite(share).any())
    return {
        "runs": counted(states),
        "premises": counted(names),
        "nearest_run": int(np.nanargmax(share)) if measured else None,
        "nearest_share": float(np.nanmax(share)) if measured else None,
    }


def _quantiles(done: Campaign) -> dict[str, Any]:
    """Return quantiles over all nominal runs, for each measured figure; no intervals, as points share
    seeds."""
    quantiles: dict[str, Any] = {}
    for name, figure in FIGURES.items():
        values = done.column(name).astype(float)[done.nominal]
        values = values[np.isfinite(values)]
        if values.size and name != "cycles":
            shares = {f"{100 * share:g} %": float(np.quantile(values, share)) for share in QUANTILES}
            quantiles[name] = {
                "unit": figure.unit,
                "runs": int(values.size),
                **shares,
                "largest": float(values.max()),
            }
    return quantiles


def _sensitivities(done: Campaign) -> dict[str, Any]:
    """Return sensitivities by key, of passing and of the peak error."""
    sensitivities = {}
    for key in done.plan.run(0).labels:
        values = done.column(key)[done.nominal]
        values = values.astype(float) if values.dtype.kind == "f" else values.astype(str)
        sensitivities[key] = {
            name: _plain(sensitivity(values, done.column(name)[done.nominal].astype(float)))
            for name in ("passed", PEAK)
        }
    return sensitivities


def worst_first(done: Campaign) -> NDArray[np.intp]:
    """Return (runs,) places in the table: failed runs first, those cut short leading, then by peak error."""
    peak = -np.nan_to_num(done.column(PEAK).astype(float), nan=np.inf)
    passed, completed = (done.column(name).astype(bool) for name in ("passed", "completed"))
    order: NDArray[np.intp] = np.lexsort((peak, completed, passed))
    return order


def worst_runs(done: Campaign, named: Collection[int] = ()) -> list[dict[str, Any]]:
    """Return the first of them, and those among the others that are ``named``."""
    keys = list(done.plan.run(0).labels)
    columns = ["run", "seed", *keys, "outcome", PEAK, "reason", "digest"]
    numbers = done.column("run").astype(int)
    order = worst_first(done)
    chosen = [place for rank, place in enumerate(order) if rank < WORST_SHOWN or numbers[place] in named]
    rows: list[dict[str, Any]] = done.table.select(columns).take(chosen).to_pylist()
    return rows


def _pairs(done: Campaign) -> list[dict[str, Any]]:
    """Compare each choice of the first non-numeric axis with the first one, all else being equal."""
    axis = next((each for each in done.plan.axes if each.numbers is None), None)
    if axis is None:
        return []
    return [_pair(done, axis, place) for place in range(1, len(axis.labels))]


def _pair(done: Campaign, axis: GridAxis, place: int) -> dict[str, Any]:
    shape, at = [len(each.labels) for each in done.plan.axes], done.plan.axes.index(axis)
    first = np.flatnonzero(np.unravel_index(done.column("point"), shape)[at] == 0)
    second = first + place * math.prod(shape[at + 1 :])  # as the plan numbers points
    both = second < done.table.num_rows
    first, second = first[both], second[both]
    passed = done.column("passed").astype(bool)
    peak = done.column(PEAK).astype(float)
    comparison = paired(
        (passed[first], passed[second]),
        (peak[first], peak[second]),
        done.plan.sweep.stop.confidence,
    )._asdict()
    change = _plain(comparison.pop("difference"), "mean")
    named = {"key": axis.title, "first": axis.labels[0], "second": axis.labels[place]}
    return {**named, **comparison, "peak_percent_second_less_first": change}


Floats = NDArray[np.float64]

_EMPTY: Final = 60
"""Grey of 255: cells without runs."""
_LINEAR_BELOW: Final = 0.04045
"""IEC 61966-2-1: darker sRGB values are linear."""


class CellMap(NamedTuple):
    """One figure of every cell, other axes pooled."""

    title: str
    values: Floats
    """(rows, columns); NaN: no run, or none with this figure."""
    low: Floats
    """(rows, columns), the interval of a pass rate; NaN where a cell pools points, which share seeds."""
    high: Floats
    runs: NDArray[np.int64]
    """(rows, columns), the run to inspect: the worst that failed, or the one with that error; -1: none."""
    is_rate: bool

    @property
    def colors(self) -> NDArray[np.uint8]:
        """(rows, columns, 3), sRGB."""
        finite = self.values[np.isfinite(self.values)]
        low, high = (0.0, 1.0) if self.is_rate or not finite.size else (finite.min(), finite.max())
        shares = (self.values - low) / (high - low) if high > low else np.full(self.values.shape, 0.5)
        shades = colormaps[self.palette](np.nan_to_num(shares))
        rgb = np.where(np.isfinite(self.values)[..., None], shades[..., :3], _EMPTY / 255.0)
        return np.asarray(np.round(255.0 * rgb), np.uint8)

    @property
    def palette(self) -> str:
        """No red against green alone: eight of a hundred men cannot distinguish them."""
        return "RdYlBu" if self.is_rate else "viridis_r"

    @property
    def inks(self) -> NDArray[np.uint8]:
        """(rows, columns, 3): black or white, whichever is legible on the cell (WCAG 2.2, contrast)."""
        share = self.colors / 255.0
        linear = np.where(share <= _LINEAR_BELOW, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        luminance = linear @ np.array((0.2126, 0.7152, 0.0722))
        black = (luminance + 0.05) / 0.05 >= 1.05 / (luminance + 0.05)
        return np.where(black[..., None], np.uint8(0), np.uint8(255)) * np.ones(3, np.uint8)

    def label(self, row: int, column: int) -> str:
        """Return the value, its interval, and the run to inspect, a line each."""
        value, low, high = (float(one[row, column]) for one in (self.values, self.low, self.high))
        if not np.isfinite(value):
            return "none"
        text = f"{value:.2f}" if self.is_rate else f"{value:.3g} %"
        if np.isfinite(low):
            text += f"\n({low:.2f} to {high:.2f})"
        run = int(self.runs[row, column])
        return f"{text}\nrun {run}" if run >= 0 else text


def cell_maps(done: Campaign, rows: GridAxis, across: GridAxis) -> tuple[CellMap, CellMap]:
    """Return pass rate and largest peak error over two axes."""
    shape = (len(rows.labels), len(across.labels))
    rate, low, high, peak = (np.full(shape, np.nan) for _ in range(4))
    failed, largest = (np.full(shape, -1) for _ in range(2))
    passed, error = done.column("passed").astype(bool), done.column(PEAK).astype(float)
    numbers, points, order = done.column("run").astype(int), done.column("point"), worst_first(done)
    for place in np.ndindex(shape):
        inside = done.at(rows, place[0]) & done.at(across, place[1])
        if not inside.any():
            continue
        rate[place] = passed[inside].mean()
        if len(own := np.unique(points[inside])) == 1:
            _, low[place], high[place] = done.pass_rate(int(own[0]))
        worst = order[inside[order]][0]
        failed[place] = -1 if passed[worst] else numbers[worst]
        known = np.flatnonzero(inside & np.isfinite(error))
        if known.size:
            top = known[np.argmax(error[known])]
            peak[place], largest[place] = error[top], numbers[top]
    nowhere = np.full(shape, np.nan)
    return (
        CellMap("pass rate", rate, low, high, failed, True),
        CellMap("largest peak error, %", peak, nowhere, nowhere, largest, False),
    )
