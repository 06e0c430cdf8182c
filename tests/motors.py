"""Motors of the papers, for tests that need one without a file."""

import math

from servobench.design.motor import PmsmParameters, Transform

LING = PmsmParameters(
    name="[Ling2012] Table 1",
    resistance_ohm=2.875,
    inductance_d_h=0.0085,
    inductance_q_h=0.0085,
    flux_linkage_wb=math.sqrt(1.5) * 0.0816,
    pole_pairs=4,
    inertia_kg_m2=0.0008,
    viscous_friction_nm_s=0.00185,
    coulomb_friction_nm=0.0,
    transform=Transform.POWER_INVARIANT,
    rated_torque_nm=2.0,
    rated_speed_rad_s=157.08,
    current_max_a=15.0,
    dc_bus_voltage_v=300.0,
)

AZAIZ = PmsmParameters(
    name="[Azaiz2007] 6",
    resistance_ohm=0.6,
    inductance_d_h=0.0014,
    inductance_q_h=0.0028,
    flux_linkage_wb=0.12,
    pole_pairs=4,
    inertia_kg_m2=1.11e-3,
    viscous_friction_nm_s=1.4e-3,
    coulomb_friction_nm=0.0,
    transform=Transform.AMPLITUDE_INVARIANT,
    rated_torque_nm=8.5,
    rated_speed_rad_s=230.0,
    current_max_a=20.0,
    dc_bus_voltage_v=300.0,
)
