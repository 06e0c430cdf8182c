"""Benches whose adapter takes no frames, is down or loses what comes, drawn by a seed."""

from dataclasses import dataclass
from random import Random
from typing import Any, Final

SHORT_S: Final = 0.03
"""No drive that is watched minds an outage as long."""
LONG_S: Final = (0.05, 0.2, 0.6, 1.4, 3.0)
"""Below and above what the drive's own supervision waits for, and the second after which a bus is down."""
LONG_PART: Final = 0.3
"""Of the benches: one outage is a long one."""
GAP_S: Final = 0.05
KINDS: Final = ("full_queue", "link_down", "receive_overflow")
STREAM: Final[dict[str, Any]] = {"kind": "stream"}
QUICK: Final[dict[str, Any]] = {"kind": "pid", "proportional_nm_s_rad": 0.12, "integral_nm_rad": 2.0}
SLOW: Final[dict[str, Any]] = {"kind": "pid", "proportional_nm_s_rad": 0.02, "integral_nm_rad": 0.1}
"""Crosses over where 100 Hz serve."""


@dataclass(frozen=True, slots=True)
class Outages:
    """A bench file's tables, and what no bench file says."""

    tables: dict[str, Any]
    beyond_the_run: bool
    """The adapter does not become sound where the run ends: its drives are stopped through it as it is."""

    def room_after_s(self, at_s: float) -> float:
        """How long a sender waits for room at ``at_s`` beside the flood of :func:`flooded`; 0: not at all."""
        (flood,) = self.tables["faults"]["full_queue"]
        periods, into_s = divmod(at_s - flood["from_s"], flood["every_s"])
        return max(0.0, flood["duration_s"] - into_s) if periods >= 1 else 0.0


def drawn(seed: int, *, real_time: bool = False) -> Outages:
    """One or two axes, in torque or speed, with up to four outages; ``real_time``: at periods that a busy
    machine bears, and with drives as ``hil simulate`` has them."""
    draw = Random(f"outages {seed}")
    outages: dict[str, list[dict[str, Any]]] = {}
    at_s = 0.3
    long_place = draw.randrange(4) if draw.random() < LONG_PART else None
    for place in range(draw.randrange(1, 5)):
        lasts_s = draw.choice((0.0005, 0.002, draw.uniform(0.001, SHORT_S * (1 + real_time))))
        if place == long_place:
            lasts_s = draw.choice(LONG_S)
        at_s += draw.uniform(0.0, 0.04)
        table = {"at_s": round(at_s, 6), "duration_s": round(lasts_s, 6)}
        outages.setdefault(draw.choice(KINDS), []).append(table)
        at_s += lasts_s + GAP_S
    duration_s = at_s + draw.choice((0.0, 0.2))
    if draw.random() < 0.3:
        duration_s = at_s - GAP_S - lasts_s * draw.random()  # it ends within the last outage
    axes = [f"axis{number}" for number in range(1, draw.choice((2, 2, 3)))]
    mode, controller = draw.choice((("cst", SLOW if real_time else QUICK), ("csv", STREAM)))
    tables: dict[str, Any] = {
        "bench": {"name": "outages", "duration_s": round(duration_s, 3), "seed": draw.randrange(99)},
        "loop": {
            "period_us": draw.choice((5000, 10_000) if real_time else (1000, 2000)),
            "actuation": draw.choice(("on_sync", "on_arrival")),
            "horizon_periods": 20,
        },
        "drive": {axis: _drive(number, mode, controller, draw) for number, axis in enumerate(axes, start=1)},
        "reference": {
            axis: [{"kind": "step", "at_s": 0.05, "speed_rpm": draw.choice((300.0, 900.0))}] for axis in axes
        },
        "verdict": {"dropouts_percent_max": draw.choice((1.0, 5.0, 20.0, 100.0))},
        "faults": outages,
    }
    if draw.random() < 0.3:
        tables["faults"]["loss"] = [{"probability": 0.01, "direction": "drive_to_host"}]
    if real_time:
        for drive in tables["drive"].values():
            del drive["simulation"]
    return Outages(tables, draw.random() < 0.5 and not real_time)


def flooded(seed: int) -> Outages:
    """The bench of ``seed`` whose adapter another program floods, from the beginning or later: there is room
    for a moment in each of its periods."""
    draw, outages = Random(f"flood {seed}"), drawn(seed)
    tables, period_us = outages.tables, outages.tables["loop"]["period_us"]
    every_s = draw.choice((0.0005, 0.001, 0.002, 1e-6 * period_us, draw.uniform(0.0002, 0.003)))
    flood = {"every_s": every_s, "duration_s": every_s * (1.0 - draw.choice((0.05, 0.1, 0.3)))}
    begin_s = draw.choice((0.0, 0.4))
    tables["bench"]["duration_s"] = 2.5  # a bus that takes nothing for a second is down
    tables["faults"] = {"full_queue": [flood | {"from_s": begin_s}]}
    return outages


def _drive(node: int, mode: str, controller: dict[str, Any], draw: Random) -> dict[str, Any]:
    return {
        "node": node,
        "mode": mode,
        "motor": "motors/ling2012.toml",
        "controller": controller,
        "simulation": {"lacks": draw.choice(([], ["1013"]))},
        "limits": {
            "speed_max_rpm": 2500.0,
            "torque_max_nm": 5.0,
            "dropouts_consecutive_max": draw.choice((10, 60, 1000)),
        },
    }
