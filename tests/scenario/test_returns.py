"""A drive that leaves its commands for a while and comes back makes no overspeed, whoever commands it.

Witness: the simulated shaft. Drawn: what the drive did meanwhile, what was asked of it, and its load.
"""

from random import Random
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.rotation import RAD_S_PER_RPM
from hil import Context, Controller, TorqueSetPoint
from hil.testing.bench_runs import BenchRunner
from tests.scenario.foreign_node import beside_the_bench
from tests.scenario.processes import EXAMPLES
from tests.scenario.test_drive_follows import NOT_FOLLOWED, Shaft
from virtual_bus.drive.servo import SimulatedServo

DURATION_S: Final = 1.4
OVERSPEED: Final = 1.05
"""Of the reference, or of the speed before, whichever is more."""
SLOWEST: Final = 0.05
"""Of limits.set_speed_max_rpm: an axis of positions makes up for what it missed as fast at least."""
LASTING_MS: Final = 15
"""A set-point that comes 0.1 ms late makes a cyclic drive jerk for a few ms, with or without a return."""
PID: Final = {"kind": "pid", "proportional_nm_s_rad": 0.12, "integral_nm_rad": 2.0}
CONTROLLERS: Final = EXAMPLES / "controllers"
POSITION: Final = {"kind": "position", "made_for": {"delay_us": 1000, "speed_bandwidth_hz": 30}}
AXES: Final[dict[str, tuple[str, Any]]] = {
    "pid": ("cst", PID),
    "hinf": ("cst", str(CONTROLLERS / "ling2012-hinf.toml")),
    "predictor": ("cst", str(CONTROLLERS / "ling2012-predictor.toml")),
    "own": ("cst", PID),
    "csv": ("csv", {"kind": "stream"}),
    "csv position": ("csv", POSITION),
    "csp": ("csp", {"kind": "stream"}),
    "ip": ("ip", {"kind": "stream"}),
    "vl": ("vl", {"kind": "stream"}),
}
POSITIONS: Final = frozenset({"csv position", "csp", "ip"})


class Proportional(Controller):
    """One of the user's own, which knows nothing of drives that leave."""

    def output(self, context: Context) -> TorqueSetPoint:
        return TorqueSetPoint(0.2 * (context.reference_rad_s - context.estimate.velocity_rad_s))


def drawn(axis: str, draw: Random) -> dict[str, Any]:
    mode, controller = AXES[axis]
    rpm = draw.choice((-1, 1)) * draw.choice((300.0, 600.0, 1000.0))
    limits = {"speed_max_rpm": 2500.0, "torque_max_nm": 5.0}
    if mode != "cst":
        limits |= {"set_speed_max_rpm": draw.choice((1100.0, 2000.0))}
    if axis in ("csp", "ip"):
        limits |= {"set_acceleration_max_rpm_s": draw.choice((5000.0, 20000.0))}
    if axis in POSITIONS:
        asked = {"kind": "ramp", "at_s": 0.1, "position_rad": rpm * RAD_S_PER_RPM, "over_s": 1.0}
    else:
        asked = {"kind": "step", "at_s": 0.05, "speed_rpm": rpm}
    away_s = draw.choice((0.05, 0.2, 0.5))
    fault: dict[str, Any] = {"nodes": [1], "at_s": round(draw.uniform(0.35, 0.5), 3), "duration_s": away_s}
    left = draw.choice(("pv", "pp", "hm")) if draw.random() < 0.5 or mode == "vl" else None
    faults = (
        {"ignored_commands": [fault | {"holds": draw.choice(("last", "zero"))}]}
        if left is None
        else {"mode_change": [fault | {"mode": left}]}
    )
    return {
        "bench": {"name": "return", "duration_s": DURATION_S, "seed": 1},
        "guard": {"on_mode": "tell"},
        "drive": {
            "axis1": {
                "node": 1,
                "mode": mode,
                "motor": str(EXAMPLES / "motors/ling2012.toml"),
                "controller": controller,
                "limits": limits,
            }
        },
        "reference": {"axis1": [asked]},
        "load": {"axis1": [{"at_s": 0.0, "torque_nm": draw.choice((0.0, 0.4))}]},
        "faults": faults,
    }


def lasting(speeds: NDArray[np.float64]) -> float:
    windows = np.lib.stride_tricks.sliding_window_view(np.abs(speeds), LASTING_MS)
    return float(np.median(windows, axis=1).max())


CASES: Final = [(axis, seed) for axis in AXES for seed in range(2 if axis in POSITIONS else 1)]


@pytest.mark.parametrize(("axis", "seed"), CASES)
def test_a_drive_that_comes_back_makes_no_overspeed(servo_bench: BenchRunner, axis: str, seed: int) -> None:
    bench = drawn(axis, Random(f"return {axis} {seed}"))
    drives: list[SimulatedServo] = []
    shaft = Shaft(drives)
    with beside_the_bench(shaft, seen=drives.append):
        ran = servo_bench(bench, controllers={"axis1": Proportional()} if axis == "own" else None)
    axis1 = ran.axis()
    away = np.flatnonzero(ran.column("command_fate") == NOT_FOLLOWED)
    before = np.nanmax(np.abs(axis1.velocity_rad_s[[away[0], away[-1]]])) / RAD_S_PER_RPM
    asked = np.abs(axis1.reference_rad_s[away[0] :]).max() / RAD_S_PER_RPM
    slowest = SLOWEST * ran.config.drive["axis1"].limits.set_speed_rpm if axis in POSITIONS else 0.0
    back_s = axis1.time_s[away[-1]]
    after = shaft.rpm(DURATION_S - back_s)
    assert lasting(after) <= OVERSPEED * max(before, asked, slowest)
    if axis not in POSITIONS | {"own"}:
        last = np.abs(axis1.velocity_rad_s[-100:]) / RAD_S_PER_RPM
        assert np.median(last) >= 0.97 * asked, "it is driven on"
