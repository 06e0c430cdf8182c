"""Maps of a campaign, a panel for each controller: ``python docs/make_campaign_map.py CAMPAIGN PICTURE``.

Largest peak error of the speed after the settling of the step, over two keys; framed: cells in which every
run kept what its controller is certified for, all premises held. The sweep has a controller axis with labels,
then the two: examples/campaigns/ling2012_controllers.toml, couplings.toml.
"""

import sys
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from servobench import Campaign
from servobench.hil.campaign.figures import PEAK

_WORDS: Final = {
    "delay_us": "delay of the readings, us",
    "periodic_loss": "readings lost in a row",
    "inertia_ratio": "load's inertia over the rotor's",
    "antiresonance_hz": "antiresonance, Hz",
}
"""By the last part of a key."""


def main() -> None:
    """Command line."""
    done = Campaign.load(sys.argv[1])
    controllers, upwards, across = done.plan.axes
    peak = done.column(PEAK).astype(float)
    peak = np.where(done.column("completed").astype(bool), peak, np.inf)
    replicates = done.table.num_rows // done.plan.points
    shape = (replicates, len(controllers.labels), len(upwards.labels), len(across.labels))
    largest = peak.reshape(shape).max(axis=0)
    kept = (done.column("certificate") == "kept").reshape(shape).all(axis=0)
    finite = largest[np.isfinite(largest)]
    norm = LogNorm(finite.min(), finite.max())
    picture = Figure(figsize=(13.0, 3.6), layout="constrained")
    panels = picture.subplots(1, shape[1], sharey=True)
    for place, axes in enumerate(np.atleast_1d(panels)):
        _panel(axes, controllers.labels[place], largest[place], kept[place], norm)
        axes.set_xticks(range(shape[3]), across.labels)
        axes.set_yticks(range(shape[2]), upwards.labels)
        axes.set_xlabel(_WORDS[across.title.rpartition(".")[2]])
    np.atleast_1d(panels)[0].set_ylabel(_WORDS[upwards.title.rpartition(".")[2]])
    image = np.atleast_1d(panels)[-1].images[0]
    picture.colorbar(image, ax=list(np.atleast_1d(panels)), label="largest speed error, % of the reference")
    picture.savefig(Path(sys.argv[2]), dpi=100, metadata={"Software": None})


def _panel(axes: Axes, title: str, largest: np.ndarray, kept: np.ndarray, norm: LogNorm) -> None:
    shown = np.where(np.isfinite(largest), largest, np.nan)
    image = axes.imshow(shown, origin="lower", aspect="auto", norm=norm)
    axes.set_title(title)
    for (row, column), value in np.ndenumerate(largest):
        red, green, blue, _ = image.cmap(image.norm(value)) if np.isfinite(value) else (1.0, 1.0, 1.0, 1.0)
        ink = "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.5 else "white"
        text = f"{value:.2f}"[:4] if np.isfinite(value) else "stopped"
        axes.text(column, row, text, ha="center", va="center", color=ink)
        if kept[row, column]:
            corner = (column - 0.46, row - 0.46)
            axes.add_patch(Rectangle(corner, 0.92, 0.92, fill=False, edgecolor="red", linewidth=2))


if __name__ == "__main__":
    main()
