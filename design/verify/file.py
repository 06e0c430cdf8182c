"""A controller's file, and what its matrices prove for every sequence of losses and delays."""

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

from flint import arb

from servobench.design.verify.balls import NotProved, number
from servobench.design.verify.loops import fused, hinf, predictor, state_feedback
from servobench.design.verify.proofs import Timed
from servobench.design.verify.windowed import ROOM, Windowed

_KINDS = {"state_feedback": state_feedback, "hinf": hinf, "predictor": predictor, "fused": fused}
_CLAIMS = (
    ("gain_certified", "gain_matrices", "rad/s per N m"),
    ("decay_certified_per_s", "decay_matrices", "1/s"),
)


@dataclass(frozen=True, slots=True)
class Claim:
    """A figure of the file, and why it could not be shown; empty where it was."""

    key: str
    figure: str
    unit: str
    refused: str


def table_of(path: Path) -> dict[str, Any]:
    """Return the table [controller] of a file, its numbers as they are written. Raises KeyError without."""
    with path.open("rb") as file:
        return dict(tomllib.load(file, parse_float=Decimal)["controller"])


def claims_of(controller: dict[str, Any], room: float = ROOM) -> Iterator[Claim]:
    """Check what a certificate over sequences claims; ``room``: see :class:`Windowed`.

    Raises KeyError for a controller without one.
    """
    claims = controller["certificate"]["sequences"]
    loop = _KINDS[controller["kind"]](controller)
    windowed = any(step.windows for step in loop.steps)
    for key, matrices, unit in _CLAIMS:
        value = number(claims[key])
        gain, decay = (value, arb(0)) if key == "gain_certified" else (None, value)
        refused = ""
        try:
            of_file = loop, claims[matrices], gain, decay
            (Windowed(*of_file, room) if windowed else Timed(*of_file)).prove()
        except NotProved as error:
            refused = str(error)
        except ZeroDivisionError:  # python-flint's, of a ball that holds a singular matrix
            refused = "a matrix that has to be inverted may be singular"
        yield Claim(key, str(claims[key]), unit, refused)
