"""Options that the commands on speed loops share."""

import math
from typing import TYPE_CHECKING, Annotated

import typer

from drivers.errors import BadInput

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SpeedOption = Annotated[
    float | None,
    typer.Option(
        "--speed-rpm", metavar="S", min=1e-6, help="Speed that percents are of; the rated if absent."
    ),
]
LoadOption = Annotated[
    float | None,
    typer.Option(
        "--load-nm", metavar="T", min=1e-9, help="Load step for percents; the rated torque if absent."
    ),
]


def gain_of(text: str) -> "NDArray[np.float64]":
    """``K1,K2`` or ``K1,K2,K3``. Raises BadInput."""
    import numpy as np

    expected = "K1,K2 in A/A and A s/rad, or K1,K2,K3 with the integral gain in A/rad, all finite"
    try:
        gains = [float(part) for part in text.split(",")]
    except ValueError:
        raise BadInput("--gain", "", text, expected) from None
    if len(gains) not in (2, 3) or not all(map(math.isfinite, gains)):
        raise BadInput("--gain", "", text, expected)
    return np.array(gains)
