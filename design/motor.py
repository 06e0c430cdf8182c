"""Parameters of a permanent-magnet synchronous motor in the rotor's dq frame.

Voltage and torque equations (n_p pole pairs, mechanical speed omega):

    v_d = R i_d + L_d di_d/dt - n_p omega L_q i_q
    v_q = R i_q + L_q di_q/dt + n_p omega (L_d i_d + phi)
    T_e = k n_p (phi i_q + (L_d - L_q) i_d i_q)
    J domega/dt = T_e - B omega - T_c sign(omega) - T_load

k is 1 with the power-invariant transform ([Ling2012] (2.1), phi = phi_a = sqrt(3/2) phi_f)
and 3/2 with the amplitude-invariant one ([Azaiz2007] (5), phi = phi_f).
"""

import math
from dataclasses import dataclass
from enum import Enum

from servobench.design.mechanism import Mechanism

RAD_S_PER_KRPM = 1000.0 * math.pi / 30.0
"""1000 r/min in rad/s: the usual reference of EMF constants."""


class Transform(Enum):
    """Scaling of the three-phase to dq transform."""

    POWER_INVARIANT = "power_invariant"
    AMPLITUDE_INVARIANT = "amplitude_invariant"


@dataclass(frozen=True, slots=True)
class PmsmParameters:
    """A PMSM and its ratings. Currents, flux and voltages are dq magnitudes of ``transform``."""

    name: str
    resistance_ohm: float
    inductance_d_h: float
    inductance_q_h: float
    flux_linkage_wb: float
    """phi of the equations above: phi_a with the power-invariant transform, phi_f with the other."""
    pole_pairs: int
    inertia_kg_m2: float
    viscous_friction_nm_s: float
    coulomb_friction_nm: float
    transform: Transform
    rated_torque_nm: float
    rated_speed_rad_s: float
    current_max_a: float
    """Largest magnitude of the dq current vector."""
    dc_bus_voltage_v: float
    mechanism: Mechanism | None = None
    """What is between rotor and load; None: they are one, and rub as the equations above say."""

    @property
    def torque_factor(self) -> float:
        """k of the torque equation."""
        return 1.0 if self.transform is Transform.POWER_INVARIANT else 1.5

    @property
    def torque_constant_nm_a(self) -> float:
        """Torque per q-axis ampere at i_d = 0, N m/A."""
        return self.torque_factor * self.pole_pairs * self.flux_linkage_wb

    @property
    def rated_current_a(self) -> float:
        """q-axis current of the rated torque at i_d = 0, A."""
        return self.rated_torque_nm / self.torque_constant_nm_a

    @property
    def voltage_max_v(self) -> float:
        """Radius of the voltage circle inside the inverter's hexagon, V."""
        phases = 2.0 if self.transform is Transform.POWER_INVARIANT else 3.0
        return self.dc_bus_voltage_v / math.sqrt(phases)

    @property
    def torque_max_nm(self) -> float:
        """Torque at ``current_max_a`` on the q axis, N m."""
        return self.torque_constant_nm_a * self.current_max_a
