"""The shaft as a predictor sees it: torque, speed and the drive's filtered speed, in closed form.

    T' = a (u - T)     J omega' = T - B omega - T_L     w' = f (omega - w)     angle' = omega

u: the command in force; T_L: the load torque, both constant over a piece; w: what 606Ch tells.
"""

import math
from typing import Final

from servobench.design.speed.predictor_plant import PredictorPlant

_APART: Final = 1e-3
"""Part of its rate by which the speed's filter is moved away from the current loop's, where they are equal:
the closed form divides by their difference."""
_COASTS: Final = 1e-6
"""1/s. A shaft that coasts longer has practically no friction."""


class ShaftMotion:
    """State at one instant; it knows no clock, pieces come with their length."""

    __slots__ = (
        "_coasted",
        "_coasting_rate",
        "_current_left",
        "_current_rate",
        "_driven_s",
        "_filter_left",
        "_filter_rate",
        "_lag",
        "_length_s",
        "_per_inertia",
        "_resonance",
        "angle_rad",
        "filtered_rad_s",
        "speed_rad_s",
        "torque_nm",
    )

    def __init__(self, plant: PredictorPlant) -> None:
        self.torque_nm = 0.0
        self.speed_rad_s = 0.0
        self.filtered_rad_s = 0.0
        self.angle_rad = 0.0
        self._per_inertia = 1.0 / plant.inertia_kg_m2
        self._coasting_rate = plant.viscous_friction_nm_s * self._per_inertia
        self._current_rate = plant.current_rate_rad_s
        rate = plant.filter_rate_rad_s
        if abs(rate - self._current_rate) < _APART * self._current_rate:
            rate = (1.0 + _APART) * self._current_rate
        self._filter_rate = rate
        self._resonance = rate / (rate - self._current_rate)
        self._lag = self._per_inertia / (self._current_rate - self._coasting_rate)
        """Speed that a missing N m costs until the current loop has made it, rad/s."""
        self._length_s = 0.0
        self._coasted = 1.0
        self._driven_s = 0.0
        self._current_left = 1.0
        self._filter_left = 1.0

    def copy(self, other: "ShaftMotion") -> None:
        """Take the state of ``other``."""
        self.torque_nm = other.torque_nm
        self.speed_rad_s = other.speed_rad_s
        self.filtered_rad_s = other.filtered_rad_s
        self.angle_rad = other.angle_rad

    def advance(self, command_nm: float, load_nm: float, length_s: float) -> None:
        """Advance by ``length_s`` under a constant command and load, N m.

        Torque and speed are exact; filter and angle take the speed's drift for a straight line within the
        piece.
        """
        if length_s <= 0.0:
            return
        if length_s != self._length_s:
            self._length_s = length_s
            self._current_left = math.exp(-self._current_rate * length_s)
            self._filter_left = math.exp(-self._filter_rate * length_s)
            self._coasted = math.exp(-self._coasting_rate * length_s)
            rate = self._coasting_rate
            self._driven_s = (1.0 - self._coasted) / rate if rate > _COASTS else length_s
        left, filter_left, coasted = self._current_left, self._filter_left, self._coasted
        speed, missing = self.speed_rad_s, command_nm - self.torque_nm
        lag = missing * self._lag
        drifted = speed * coasted + (command_nm - load_nm) * self._per_inertia * self._driven_s
        drifted += lag * (1.0 - coasted)
        behind = (drifted - speed) / (self._filter_rate * length_s)
        turned = lag * self._resonance
        self.torque_nm = command_nm - missing * left
        self.angle_rad += 0.5 * (speed + drifted) * length_s - lag * (
            length_s - (1.0 - left) / self._current_rate
        )
        self.speed_rad_s = drifted - lag * (1.0 - left)
        self.filtered_rad_s = (
            drifted
            - behind
            - lag
            + turned * left
            + filter_left * (self.filtered_rad_s - speed + behind + lag - turned)
        )
