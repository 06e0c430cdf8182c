"""Drives that leave their commands for a while and come back, whoever commands them: benches drawn by number,
and how fast the shaft went after the return.

Witness: the simulated shaft, from the instant at which the fault ends, whatever the bench knows of it.

    asked       the highest reference since the drive left
    left, back  the shaft's highest speed in the 100 ms before the drive left, its speed as it comes back:
                what it has then already is no overspeed after the return
    slowest     an axis of positions makes up for what it missed at this speed at least
"""

from collections.abc import Callable, Mapping
from random import Random
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench import Context, Controller, Run, TorqueSetPoint
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.scenario.foreign_node import beside_the_bench
from tests.scenario.processes import EXAMPLES
from tests.scenario.test_drive_follows import Shaft

DURATION_S: Final = 1.4
BEFORE_S: Final = 0.1
OVERSPEED: Final = 1.05
SLOWEST: Final = 0.05
"""Of limits.set_speed_max_rpm."""
DRIVEN_ON: Final = 0.97
LASTING_MS: Final = 15
"""A drive that takes positions as they arrive draws each line from its arrival (docs/simulated-drive.md): one
that waits 0.1 ms for another frame makes it jerk for some ms, with or without a return. Of such a drive the
median of so many ms counts, of every other each ms."""
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


class Returned(NamedTuple):
    """What became of a return."""

    overspeed: float
    """The highest speed after it, of the highest of asked, left, back and slowest."""
    driven: float
    """The speed in the last 100 ms, of the reference; 1 where that is no speed, or is not kept."""

    @property
    def wrong(self) -> bool:
        """It was too fast, or is not driven on."""
        return self.overspeed > OVERSPEED or self.driven < DRIVEN_ON


def drawn(axis: str, number: int) -> dict[str, Any]:
    """The tables of a bench."""
    draw = Random(f"return {axis} {number}")
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
    load_nm = draw.choice((0.0, 0.4))
    actuation = draw.choice(("on_arrival", "on_sync")) if axis in POSITIONS else "on_arrival"
    return {
        "bench": {"name": "return", "duration_s": DURATION_S, "seed": 1},
        "loop": {"actuation": actuation},
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
        "load": {"axis1": [{"at_s": 0.0, "torque_nm": load_nm}]},
        "faults": faults,
    }


def returned(axis: str, number: int, run: Callable[..., Run]) -> Returned:
    """Run a drawn bench by ``run``, which is called as :func:`hil.run` is, and look at its shaft."""
    bench = drawn(axis, number)
    drives: list[SimulatedServo] = []
    shaft = Shaft(drives)
    with beside_the_bench(shaft, seen=drives.append):
        ran = run(bench, controllers={"axis1": Proportional()} if axis == "own" else None)
    [[fault]] = bench["faults"].values()
    left_s, back_s = fault["at_s"], fault["at_s"] + fault["duration_s"]
    axis1 = ran.axis()
    asked = np.abs(axis1.reference_rad_s[axis1.time_s >= left_s]).max() / RAD_S_PER_RPM
    limits = ran.config.drive["axis1"].limits
    slowest = SLOWEST * limits.set_speed_rpm if axis in POSITIONS else 0.0
    counted = lasting if _jerks(bench) else np.abs
    before = counted(shaft.between(ran, left_s - BEFORE_S, left_s)).max()
    after = shaft.between(ran, back_s, DURATION_S)
    most = max(asked, before, abs(after[0]), slowest)
    if axis in POSITIONS | {"own"}:
        return Returned(counted(after).max() / most, 1.0)
    last = shaft.between(ran, DURATION_S - BEFORE_S, DURATION_S)
    return Returned(counted(after).max() / most, np.median(np.abs(last)) / asked)


def _jerks(bench: Mapping[str, Any]) -> bool:
    """Whether its drive takes positions as they arrive."""
    return bench["drive"]["axis1"]["mode"] in ("csp", "ip") and bench["loop"]["actuation"] == "on_arrival"


def lasting(speeds: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) speeds, one a ms, to (n - 14,) medians of their amounts."""
    windows = np.lib.stride_tricks.sliding_window_view(np.abs(speeds), LASTING_MS)
    medians: NDArray[np.float64] = np.median(windows, axis=1)
    return medians
