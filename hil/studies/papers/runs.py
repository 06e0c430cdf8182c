"""Cases 1 to 3 of [Ling2012] on the simulated bench: real sampling, delay and loss through the bus.

A sample takes 4 ms to the host; five of every six set-points are lost on the way to the drive. As the
feedback is static, a lost set-point is to the loop what a lost sample is, [Ling2012] (2.11), but
all readings come, so that the recording shows what the motor really does. The drive's current loops
are as slow as the paper's, R/L. Samples act at SYNCs where they are postponed, so the agreed 64 ms become 70,
the first SYNC at which a sample is as old. The strategy history needs packets that carry six samples, which a
PDO of eight bytes cannot; without loss, stamp is the same thing, and runs in its place.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.papers.ling2012 import (
    DELAY_S,
    LOAD_NM,
    LOAD_ON_S,
    LOSSES,
    MOTOR,
    PERIOD_S,
    PID_DELAY_S,
    SPEED_RAD_S,
    TAU_S,
    K,
    pi_gains,
)
from drivers.rotation import RAD_S_PER_RPM
from drivers.timebase import NS_PER_S
from hil.configuration.bench_file import bench_from
from hil.configuration.motor_file import LING2012
from hil.execution.bench import run_bench
from hil.machine.stopping import Interrupted
from hil.rows.records_file import RECORDS_FILE, read_records
from hil.verdict.verdict import VerdictKind

CAREFUL_RAD_S, EAGER_RAD_S = 60.0, 200.0
"""Crossings of the two PI controllers of Case 2, both well damped without sampling."""
ACTS_AT_AGE_S = math.ceil(DELAY_S / PERIOD_S) * PERIOD_S
"""Of postponed samples."""
LOAD_AT_S = 3.0
"""Of Case 3, when the start is over; 0.5 s in the paper, where it is not (Case 1)."""
_BANDS = (0.05, 0.02)
_END_S = 0.2
"""So long, at its end, a run must stay within 5 % to count as settled."""


@dataclass(frozen=True, slots=True)
class Variant:
    """One bench run."""

    case: str
    name: str
    lossy: bool
    delay_s: float
    load: bool = False
    pi_rad_s: float | None = None
    """Crossing of a PI controller; None: the state feedback of the paper."""

    @property
    def waits(self) -> bool:
        """Whether samples are applied at the agreed age."""
        return self.name in ("stamp", "history")


VARIANTS = (
    Variant("case1", "stamp", lossy=True, delay_s=TAU_S),
    Variant("case1", "arrival", lossy=True, delay_s=TAU_S),
    Variant("case2", "pi_careful", lossy=False, delay_s=PID_DELAY_S, pi_rad_s=CAREFUL_RAD_S),
    Variant("case2", "pi_eager", lossy=False, delay_s=PID_DELAY_S, pi_rad_s=EAGER_RAD_S),
    Variant("case3", "stamp", lossy=True, delay_s=TAU_S, load=True),
    Variant("case3", "arrival", lossy=True, delay_s=TAU_S, load=True),
    Variant("case3", "history", lossy=False, delay_s=TAU_S, load=True),
)


@dataclass(frozen=True, slots=True, eq=False)
class PaperRun:
    """A recorded run: instants, (n,) s, and speed error there, rad/s."""

    case: str
    variant: str
    time_s: NDArray[np.float64]
    error_rad_s: NDArray[np.float64]
    figures: dict[str, Any]


def bench_tables(variant: Variant) -> dict[str, Any]:
    """The bench file of a variant."""
    us = round(1e6 * PERIOD_S)
    tables: dict[str, Any] = {
        "bench": {
            "name": f"ling2012-{variant.case}-{variant.name.replace('_', '-')}",
            "duration_s": LOAD_AT_S + 1.5 if variant.load else 2.0,
            "seed": 2012,
        },
        "loop": {
            "period_us": us,
            "decide_after_us": round(1e6 * variant.delay_s) + 600,
            "deadline_us": us,
            "horizon_periods": 20,
            "actuation": "on_sync" if variant.waits else "on_arrival",
        },
        "drive": {
            "axis1": {
                "node": 1,
                "motor": LING2012.model_dump(mode="json"),
                "simulation": {
                    "current_bandwidth_hz": round(MOTOR.resistance_ohm / MOTOR.inductance_q_h / math.tau, 4)
                },
                "limits": {"speed_max_rpm": 3000.0, "torque_max_nm": 5.9},
                "compensator": _compensator(variant),
                "controller": _controller(variant),
            }
        },
        "reference": {
            "axis1": [{"at_s": 0.0, "kind": "step", "speed_rpm": round(SPEED_RAD_S / RAD_S_PER_RPM, 6)}]
        },
        "faults": _faults(variant),
    }
    if variant.load:
        tables["load"] = {
            "axis1": [
                {"at_s": LOAD_AT_S, "torque_nm": LOAD_NM},
                {"at_s": LOAD_AT_S + LOAD_ON_S, "torque_nm": 0.0},
            ]
        }
    return tables


def _compensator(variant: Variant) -> dict[str, Any]:
    return {"kind": "stamp", "delay_us": round(1e6 * ACTS_AT_AGE_S)} if variant.waits else {"kind": "arrival"}


def _controller(variant: Variant) -> dict[str, Any]:
    if variant.pi_rad_s is None:
        return {"kind": "state_feedback", "gain": K.tolist()}
    proportional, integral = pi_gains(variant.pi_rad_s)
    return {
        "kind": "pid",
        "proportional_nm_s_rad": proportional,
        "integral_nm_rad": integral,
        "feedforward_nm_s_rad": MOTOR.viscous_friction_nm_s,
    }


def _faults(variant: Variant) -> dict[str, Any]:
    tables: dict[str, Any] = {
        "delay": [{"direction": "drive_to_host", "delay_us": round(1e6 * variant.delay_s)}]
    }
    if variant.lossy:
        tables["periodic_loss"] = [{"direction": "host_to_drive", "lost": LOSSES}]
    return tables


def run_cases(folder: Path, tell: Callable[[str], None]) -> list[PaperRun]:
    """Every variant, each recorded in a folder of its own below ``folder``."""
    return [_run(variant, folder, tell) for variant in VARIANTS]


def _run(variant: Variant, folder: Path, tell: Callable[[str], None]) -> PaperRun:
    config = bench_from(bench_tables(variant), f"{variant.case} {variant.name}", Path())
    tell(f"{variant.case}, {variant.name}: on the simulated bench")
    record = folder / config.bench.name
    summary = run_bench(config, record=record)
    if ended_by := summary.verdict.of(VerdictKind.INTERRUPTED):
        raise Interrupted("; ".join(ended_by))
    time_s, error = _errors(record)
    figures = _figures(variant, time_s, error) | {
        "delay_p99_us": summary.delay_us.p99,
        "recording": str(record),
    }
    return PaperRun(variant.case, variant.name, time_s, error, figures)


def _errors(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rows = np.concatenate(list(read_records(folder / RECORDS_FILE)))
    came = np.isfinite(rows["velocity_rad_s"])
    time_s = (rows["sampled_at"] - rows["due_at"][0]) / NS_PER_S
    return time_s[came], (rows["reference_rad_s"] - rows["velocity_rad_s"])[came]


def _figures(
    variant: Variant, time_s: NDArray[np.float64], error: NDArray[np.float64]
) -> dict[str, float | bool | None]:
    share = error / SPEED_RAD_S
    if not variant.load:
        return {
            "settled": bool(np.abs(share[time_s > time_s[-1] - _END_S]).max() < _BANDS[0]),
            "overshoot_percent": 100.0 * max(0.0, -float(share.min())),
            **_settling(time_s, share, "settling"),
        }
    loaded = time_s >= LOAD_AT_S
    gone_s = LOAD_AT_S + LOAD_ON_S
    after = time_s >= gone_s
    return {
        "peak_rad_s": float(np.abs(error[loaded]).max()),
        "peak_percent": 100.0 * float(np.abs(share[loaded]).max()),
        "swing_back_percent": 100.0 * max(0.0, -float(share[loaded].min())),
        **_settling(time_s[after] - gone_s, share[after], "recovery"),
    }


def _settling(time_s: NDArray[np.float64], share: NDArray[np.float64], name: str) -> dict[str, float | None]:
    """When |share| stays within each band from then on; None if it is outside at the end."""
    times_s: dict[str, float | None] = {}
    for band in _BANDS:
        outside = np.flatnonzero(np.abs(share) > band)
        first = outside[-1] + 1 if len(outside) else 0
        times_s[f"{name}_{100 * band:g}_percent_s"] = None if first == len(share) else float(time_s[first])
    return times_s
