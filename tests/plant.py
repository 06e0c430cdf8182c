"""The motor of the simulated drive without its firmware, for tests that drive it by voltages."""

import numpy as np

from design.motor import PmsmParameters
from virtual_bus.drive import motor_kernel as kernel
from virtual_bus.drive.firmware import fill_machine


class Plant:
    """The motor alone, at rest and without current at first; the firmware drives the same kernel."""

    def __init__(self, motor: PmsmParameters, period_s: float = 1.0 / 16_000) -> None:
        """``period_s``: what one ``advance`` covers."""
        self._p = np.zeros(kernel.PARAMETERS_SIZE)
        self._state = np.zeros(kernel.STATE_SIZE)
        fill_machine(self._p, motor, period_s)

    def advance(
        self, voltage_d_v: float, voltage_q_v: float, load_nm: float = 0.0, *, stator_fixed: bool = True
    ) -> None:
        """One period under a voltage that is (d, q) in the rotor's frame at its start.

        ``stator_fixed``: the voltage stands still in the stator's frame while the rotor turns, as that of an
        inverter does within one PWM period; otherwise it turns with the rotor.
        """
        turning = 1.0 if stator_fixed else 0.0
        kernel.advance_plant(self._state, self._p, voltage_d_v, voltage_q_v, 1.0, turning, load_nm, 0.0)

    def spin(self, speed_rad_s: float) -> None:
        """Set the shaft's speed, as if it had been driven there from outside."""
        self._state[kernel.S_SPEED] = speed_rad_s

    @property
    def current_d_a(self) -> float:
        return float(self._state[kernel.S_CURRENT_D])

    @property
    def current_q_a(self) -> float:
        return float(self._state[kernel.S_CURRENT_Q])

    @property
    def speed_rad_s(self) -> float:
        """Mechanical."""
        return float(self._state[kernel.S_SPEED])

    @property
    def turns(self) -> int:
        """Whole turns; ``angle_rad`` is the rest."""
        return int(self._state[kernel.S_TURNS])

    @property
    def angle_rad(self) -> float:
        """Mechanical, 0 <= angle < 2 pi."""
        return float(self._state[kernel.S_ANGLE])
