"""The motor of the simulated drive without its firmware, for tests that drive it by voltages."""

import math

from servobench.design.motor import PmsmParameters
from servobench.virtual_bus.core.native import InnerLoops
from servobench.virtual_bus.drive.firmware import fill_machine


class Plant:
    """The motor alone, at rest and without current at first; the firmware drives the same."""

    def __init__(self, motor: PmsmParameters, period_s: float = 1.0 / 16_000) -> None:
        """``period_s``: what one ``advance`` covers."""
        self._inner = InnerLoops()
        self._periods = 0
        fill_machine(self._inner, motor, period_s)

    def advance(
        self,
        voltage_d_v: float,
        voltage_q_v: float,
        load_nm: float = 0.0,
        *,
        stator_fixed: bool = True,
        periods: int = 1,
    ) -> None:
        """Periods, each under a voltage that is (d, q) in the rotor's frame at its start.

        ``stator_fixed``: the voltage stands still in the stator's frame while the rotor turns, as that of an
        inverter does within one PWM period; otherwise it turns with the rotor.
        """
        turning = 1.0 if stator_fixed else 0.0
        self._periods += periods
        self._inner.advance_motor(voltage_d_v, voltage_q_v, load_nm, turning, periods)

    def spin(self, speed_rad_s: float, load_speed_rad_s: float | None = None) -> None:
        """Set the shaft's speed, as if it had been driven there from outside; that of both its ends if the
        load's is None."""
        self._inner.speed_rad_s = speed_rad_s
        self._inner.load_speed_rad_s = speed_rad_s if load_speed_rad_s is None else load_speed_rad_s

    def set_angle(self, turns: float) -> None:
        """Set where the shaft is, as if it had been turned there from outside."""
        self._inner.turns = math.floor(turns)
        self._inner.angle_rad = (turns - math.floor(turns)) * math.tau

    def time_s(self, period_s: float) -> float:
        """Of all that it has advanced."""
        return self._periods * period_s

    @property
    def stop_hits(self) -> int:
        """How often an end stop has been hit."""
        return int(self._inner.stop_hits)

    @property
    def stop_hit_rad_s(self) -> float:
        """Speed at the last hit."""
        return self._inner.stop_hit_rad_s

    @property
    def current_d_a(self) -> float:
        return self._inner.current_d_a

    @property
    def current_q_a(self) -> float:
        return self._inner.current_q_a

    @property
    def speed_rad_s(self) -> float:
        """Mechanical."""
        return self._inner.speed_rad_s

    @property
    def load_speed_rad_s(self) -> float:
        """Behind the coupling."""
        return self._inner.load_speed_rad_s

    @property
    def twist_rad(self) -> float:
        """Rotor's angle less the load's."""
        return self._inner.twist_rad

    @property
    def turns(self) -> int:
        """Whole turns; ``angle_rad`` is the rest."""
        return int(self._inner.turns)

    @property
    def angle_rad(self) -> float:
        """Mechanical, 0 <= angle < 2 pi."""
        return self._inner.angle_rad
