"""A drive whose motion nothing of the house integrates: scipy's solve_ivp, with friction's events located.

The bench of a drawn drive runs once, for its instants: when each cycle sampled, and when its command arrived.
Then another drive is put there: its shaft, its torque's lag and the filter of its speed are ordinary
differential equations, integrated from one command to the next, under a PI controller of the test.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.integrate import solve_ivp

from servobench import run
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.rows.records import Rows
from tests.twin.drawn import Hidden

EVENTS_MAX: Final = 8
"""Between two commands; more would be a chattering of the test's own."""
DEAD_TIME_S: Final = 150e-6
LAG_S: Final = 1.0 / (math.tau * 800.0)
COUNTS: Final = 65_536
SPEED_STEP_RAD_S: Final = 0.01


@dataclass(frozen=True, slots=True)
class Integrated:
    """A run by its three parts that a fit reads."""

    config: BenchConfig
    rows: Rows
    digest: str = "integrated"


@dataclass(slots=True)
class Shaft:
    """The drive, between two instants with one set-point."""

    inertia: float
    viscous: float
    coulomb: float
    hanging: float
    filter_s: float
    state: Any
    """Angle, speed, torque, filtered speed."""
    way: int = 0
    """Of the motion; 0: friction holds the shaft."""

    def _slopes(self, _at_s: float, state: Any, set_point: float) -> Sequence[float]:
        _angle, speed, torque, told = state
        driving = torque - self.hanging
        moved = (driving - self.viscous * speed - self.way * self.coulomb) / self.inertia if self.way else 0.0
        return speed, moved, (set_point - torque) / LAG_S, (speed - told) / self.filter_s

    def advance(self, seconds: float, set_point: float) -> None:
        """Integrate, from event to event."""

        def stands(_at_s: float, state: Any, _set_point: float) -> float:
            return float(state[1]) if self.way else self.coulomb - abs(float(state[2]) - self.hanging)

        stands.terminal = True  # type: ignore[attr-defined]
        left, driving = seconds, float(self.state[2]) - self.hanging
        if not self.way and abs(driving) > self.coulomb:  # from the first instant on
            self.way = int(math.copysign(1.0, driving))
        for _ in range(EVENTS_MAX):
            stands.direction = -self.way if self.way else -1  # type: ignore[attr-defined]
            done = solve_ivp(
                self._slopes,
                (0.0, left),
                self.state,
                events=stands,
                args=(set_point,),
                rtol=1e-9,
                atol=1e-10,
                max_step=0.5 * left,
            )
            self.state = done.y[:, -1]
            left -= float(done.t[-1])
            if left <= 1e-12:
                return
            driving = float(self.state[2]) - self.hanging
            self.state[1] = 0.0
            self.way = 0 if self.way and abs(driving) <= self.coulomb else int(math.copysign(1.0, driving))
        raise RuntimeError(f"{EVENTS_MAX} events in {seconds:g} s")


def integrated(hidden: Hidden) -> Integrated:
    """Return a recording of the drive of ``hidden`` on a bus without faults, made by solve_ivp."""
    bench = {key: table for key, table in hidden.bench.items() if key != "faults"}
    base = run(bench, signals={"reference.axis1.speed_rpm": hidden.speed_rpm})
    rows, truth = base.rows.copy(), hidden.truth
    shaft = Shaft(
        truth["mechanics.inertia_kg_m2"],
        truth["mechanics.viscous_friction_nm_s"],
        truth["mechanics.coulomb_friction_nm"],
        truth["load.hanging_nm"],
        1.0 / (math.tau * truth["twin.speed_filter_hz"]),
        np.zeros(4),
    )
    raw = rows["command_raw"].astype(float)
    known = np.isfinite(rows["command_torque_nm"]) & (np.abs(raw) > 10) & (np.abs(raw) < 1e6)
    unit_nm = float(raw[known] @ rows["command_torque_nm"][known] / (raw[known] @ raw[known]))
    gain, integral, summed = 60.0 * shaft.inertia, 600.0 * shaft.inertia, 0.0
    begin = int(rows["sampled_at"][0])
    now_s, set_point, waiting = 0.0, 0.0, (math.inf, 0.0)
    for row in rows:
        at_s = (int(row["sampled_at"]) - begin) / NS_PER_S
        if waiting[0] <= at_s:
            shaft.advance(waiting[0] - now_s, set_point)
            now_s, set_point = waiting
        if at_s > now_s:
            shaft.advance(at_s - now_s, set_point)
            now_s = at_s
        angle, _speed, torque, told = shaft.state
        speed = SPEED_STEP_RAD_S * round(told / SPEED_STEP_RAD_S)
        error = hidden.speed_rpm(at_s) * math.pi / 30.0 - speed
        summed += error * 1e-3
        command = round((gain * error + integral * summed) / unit_nm)
        row["velocity_rad_s"] = speed
        row["position_rad"] = math.tau / COUNTS * math.floor(angle * COUNTS / math.tau)
        row["torque_nm"] = unit_nm * round(torque / unit_nm)
        row["position_told_at"] = row["torque_told_at"] = row["received_at"]
        row["command_raw"], row["command_torque_nm"] = command, unit_nm * command
        waiting = ((int(row["command_on_bus_at"]) - begin) / NS_PER_S + DEAD_TIME_S, unit_nm * command)
    return Integrated(base.config, rows)
