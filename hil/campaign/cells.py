"""The cells of a map over two axes of a campaign: the results of the runs in each, and their display."""

from typing import Final, NamedTuple

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from servobench.hil.campaign.campaign import Campaign
from servobench.hil.campaign.figures import PEAK, worst_first
from servobench.hil.campaign.plan import GridAxis

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
        """Return the value, its interval, and the run to inspect."""
        value, low, high = (float(one[row, column]) for one in (self.values, self.low, self.high))
        if not np.isfinite(value):
            return "none"
        text = f"{value:.2f}" if self.is_rate else f"{value:.3g} %"
        if np.isfinite(low):
            text += f" ({low:.2f} to {high:.2f})"
        run = int(self.runs[row, column])
        return f"{text}, run {run}" if run >= 0 else text


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
