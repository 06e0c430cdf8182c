"""Parameters of a permanent-magnet synchronous motor in the rotor's dq frame.

Voltage and torque equations (n_p pole pairs, mechanical speed omega):

    v_d = R i_d + L_d di_d/dt - n_p omega L_q i_q
    v_q = R i_q + L_q di_q/dt + n_p omega (L_d i_d + phi)
    T_e = k n_p (phi i_q + (L_d - L_q) i_d i_q)
    J domega/dt = T_e - B omega - T_c sign(omega) - T_load

k is 1 with the power-invariant transform ([Ling2012] (2.1), phi = phi_a = sqrt(3/2) phi_f)
and 3/2 with the amplitude-invariant one ([Azaiz2007] (5), phi = phi_f).

Figures derived from a motor's parameters, to compare with a data sheet and to choose a drive.

The constants that define a motor's flux on data sheets, and their conventions.

A sheet gives p phi (pole pairs times flux linkage, the peak of a phase's back-EMF per mechanical rad/s) in
one of nine ways, which differ by sqrt(2), sqrt(3), 3/2 and pi/3 and are seldom distinguished. For a
sinusoidal back-EMF:

    torque per line current, rms      Kt = 3/sqrt(2) p phi        three phases, current in phase with EMF
    torque per line current, peak     Kt = 3/2 p phi
    torque per DC current, six-step   Kt = 3 sqrt(3)/pi p phi     two phases at a time, mean over 60 degrees
    back-EMF between terminals, rms   Ke = sqrt(3/2) p phi        sqrt(3) times the phase's
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.design.iron import Iron
from servobench.design.mechanism import Mechanism

RAD_S_PER_KRPM = 1000.0 * math.pi / 30.0
"""1000 r/min in rad/s: the usual reference of EMF constants."""


class Transform(Enum):
    """Scaling of the three-phase to dq transform."""

    POWER_INVARIANT = "power_invariant"
    AMPLITUDE_INVARIANT = "amplitude_invariant"


@dataclass(frozen=True, slots=True)
class Heat:
    """What temperature makes of the figures: a share of each."""

    resistance_factor: float
    flux_factor: float
    winding_c: float = 20.0
    viscous_factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Commutation:
    """How encoder and lines of the motor are joined, where a drive has to be told."""

    offset_rad: float = 0.0
    """Electrical angle to be added to the encoder's."""
    lines_swapped: bool = False
    """The rotor's electrical angle falls while the encoder's rises."""
    pole_pairs_set: int | None = None
    """Pole pairs that the drive is delivered with; None: the motor's."""


UNHEATED: Final = Heat(1.0, 1.0)
"""A motor whose file names no temperature."""


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
    iron: Iron | None = None
    """Saturation of the motor as it is; None: constant inductances. No drive and no design knows of it."""
    heat: Heat | None = None
    """Temperature of the motor as it is; None: resistance and flux are those above."""
    commutation: Commutation | None = None
    """None: every drive commutates by the rotor's angle."""

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


Array = NDArray[np.float64]


def phase_emf_constant(motor: PmsmParameters) -> float:
    """Return the peak of a phase's back-EMF per mechanical rad/s, V s."""
    scale = math.sqrt(2.0 / 3.0) if motor.transform is Transform.POWER_INVARIANT else 1.0
    return motor.pole_pairs * motor.flux_linkage_wb * scale


def phase_peak(motor: PmsmParameters) -> float:
    """Return the peak of a phase's current or voltage per dq magnitude of the motor's transform."""
    return math.sqrt(2.0 / 3.0) if motor.transform is Transform.POWER_INVARIANT else 1.0


def torque_limit(motor: PmsmParameters, speed_rad_s: Array) -> Array:
    """Return the largest torque (k,) in N m with i_d = 0 at k speeds >= 0, within current and voltage circle.

    (R i + w phi)^2 + (w L_q i)^2 <= V^2 with the electrical speed w, friction not subtracted. Zero where the
    back-EMF alone exceeds the voltage: there is no field weakening, here or in the simulated drive.
    """
    omega = motor.pole_pairs * speed_rad_s
    emf = omega * motor.flux_linkage_wb
    square = motor.resistance_ohm**2 + (omega * motor.inductance_q_h) ** 2
    linear = motor.resistance_ohm * emf
    root = np.sqrt(np.maximum(linear**2 - square * (emf**2 - motor.voltage_max_v**2), 0.0))
    current = np.where(emf <= motor.voltage_max_v, (root - linear) / square, 0.0)
    return motor.torque_constant_nm_a * np.minimum(current, motor.current_max_a)


def speed_limit(motor: PmsmParameters, torque_nm: float) -> float:
    """Return the largest speed in rad/s at which ``torque_nm`` is available with i_d = 0; 0.0 if at none."""
    no_load = motor.voltage_max_v / (motor.pole_pairs * motor.flux_linkage_wb)
    if float(torque_limit(motor, np.zeros(1))[0]) < torque_nm:
        return 0.0
    low, high = 0.0, no_load
    while high - low > 1e-9 * no_load:  # the limit falls with the speed
        middle = 0.5 * (low + high)
        low, high = (
            (middle, high) if torque_limit(motor, np.array([middle]))[0] >= torque_nm else (low, middle)
        )
    return low


def mechanism_figures(motor: PmsmParameters) -> dict[str, float]:
    """Those of coupling, friction, cogging and load; none of what is not there."""
    mechanism, figures = motor.mechanism, dict[str, float]()
    if mechanism is None:
        return figures
    if (coupling := mechanism.coupling) is not None:
        figures |= {
            "antiresonance_hz": coupling.antiresonance_hz,
            "resonance_hz": coupling.resonance_hz,
            "stiffness_nm_rad": coupling.stiffness_nm_rad,
            "twist_rated_torque_mrad": 1e3 * motor.rated_torque_nm / coupling.stiffness_nm_rad,
        }
        if coupling.backlash_rad:
            figures["backlash_arcmin"] = math.degrees(coupling.backlash_rad) * 60.0
    if (friction := mechanism.friction) is not None:
        figures["breakaway_percent_of_rated"] = 100.0 * friction.breakaway_nm / motor.rated_torque_nm
        if friction.bristle_nm_rad:
            figures["bristles_slip_after_mrad"] = 1e3 * friction.breakaway_nm / friction.bristle_nm_rad
    if mechanism.cogging or mechanism.cogging_points_nm:
        peak_nm = sum(harmonic.torque_nm for harmonic in mechanism.cogging)
        peak_nm += max(map(abs, mechanism.cogging_points_nm), default=0.0)
        figures["cogging_percent_of_rated"] = 100.0 * peak_nm / motor.rated_torque_nm
    return figures | _load_figures(motor, mechanism)


def _load_figures(motor: PmsmParameters, mechanism: Mechanism) -> dict[str, float]:
    load, figures = mechanism.load, dict[str, float]()
    if load is None:
        return figures
    if load.hanging_nm:
        figures["hanging_percent_of_rated"] = 100.0 * load.hanging_nm / motor.rated_torque_nm
    if load.arm is not None:
        figures["arm_percent_of_rated"] = 100.0 * load.arm.torque_nm / motor.rated_torque_nm
        figures["arm_swings_hz"] = math.sqrt(load.arm.stiffness_nm_rad / motor.inertia_kg_m2) / math.tau
    if load.table is not None:
        peak_nm = max(abs(torque_nm) for row in load.table.torques_nm for torque_nm in row)
        figures["table_peak_percent_of_rated"] = 100.0 * peak_nm / motor.rated_torque_nm
    if load.stops is not None:
        load_kg_m2 = mechanism.load_kg_m2(motor.inertia_kg_m2)
        stiffness = load.stops.stiffness_nm_rad
        figures["stop_hz"] = math.sqrt(stiffness / load_kg_m2) / math.tau
        figures["stop_peak_at_rated_speed_nm"] = motor.rated_speed_rad_s * math.sqrt(stiffness * load_kg_m2)
    return figures


def motor_figures(motor: PmsmParameters) -> dict[str, float]:
    """Return derived figures, the unit last in each name. ``_rms`` and ``_peak``: of a phase's sine."""
    emf = phase_emf_constant(motor)
    peak = phase_peak(motor)
    rpm = 30.0 / math.pi
    return {
        "kt_nm_arms": 3.0 / math.sqrt(2.0) * emf,
        "kt_nm_apk": 1.5 * emf,
        "ke_line_vrms_krpm": math.sqrt(1.5) * emf * RAD_S_PER_KRPM,
        "rated_current_arms": motor.rated_current_a * peak / math.sqrt(2.0),
        "peak_current_arms": motor.current_max_a * peak / math.sqrt(2.0),
        "peak_torque_nm": motor.torque_max_nm,
        "rated_power_w": motor.rated_torque_nm * motor.rated_speed_rad_s,
        "short_circuit_current_arms": motor.flux_linkage_wb / motor.inductance_d_h * peak / math.sqrt(2.0),
        "tau_electrical_ms": 1e3 * motor.inductance_q_h / motor.resistance_ohm,
        "tau_mechanical_ms": 1e3 * motor.resistance_ohm * motor.inertia_kg_m2 / (1.5 * emf**2),
        "motor_constant_nm_sqrt_w": emf * math.sqrt(1.5 / motor.resistance_ohm),
        "copper_loss_rated_w": 1.5 * (motor.rated_current_a * peak) ** 2 * motor.resistance_ohm,
        "no_load_speed_rpm": motor.voltage_max_v / (motor.pole_pairs * motor.flux_linkage_wb) * rpm,
        "base_speed_rated_torque_rpm": speed_limit(motor, motor.rated_torque_nm) * rpm,
        "base_speed_peak_torque_rpm": speed_limit(motor, motor.torque_max_nm) * rpm,
        "acceleration_peak_krad_s2": 1e-3 * motor.torque_max_nm / motor.inertia_kg_m2,
        "time_to_rated_speed_ms": 1e3 * motor.inertia_kg_m2 * motor.rated_speed_rad_s / motor.torque_max_nm,
        "electrical_frequency_rated_hz": motor.pole_pairs * motor.rated_speed_rad_s / (2.0 * math.pi),
        **mechanism_figures(motor),
    }


AGREEING = 0.12
"""Share by which two figures of one sheet may differ. Makers allow their figures 10 %, and give torque per
ampere for a warm motor and back-EMF for a cold one; most wrong conventions are 28 % apart or more."""

_SIX_STEP = 3.0 * math.sqrt(3.0) / math.pi
"""Mean of three phases' rectified voltage, over the peak of one."""

FLUX_FACTORS: Mapping[str, float] = {
    "kt_nm_arms": 3.0 / math.sqrt(2.0),
    "kt_nm_apk": 1.5,
    "kt_nm_adc": _SIX_STEP,
    "ke_line_vrms_krpm": math.sqrt(1.5) * RAD_S_PER_KRPM,
    "ke_line_vpk_krpm": math.sqrt(3.0) * RAD_S_PER_KRPM,
    "ke_phase_vrms_krpm": math.sqrt(0.5) * RAD_S_PER_KRPM,
    "ke_phase_vpk_krpm": RAD_S_PER_KRPM,
}
"""The sheet's figures for p phi -> figure per p phi in V s. The first one given defines the flux."""
SPEED_FACTORS: Mapping[str, float] = {
    "kv_rpm_vdc": _SIX_STEP * math.pi / 30.0,
    "kv_rpm_vpk": math.sqrt(3.0) * math.pi / 30.0,
}
"""The same for figures that are inverse to p phi: r/min per volt of a six-step drive's DC, and of the peak
between terminals."""
CONVENTIONS = (*FLUX_FACTORS, *SPEED_FACTORS)


def emf_constant(name: str, value: float) -> float:
    """Return p phi in V s from one figure; ``name``: one of ``CONVENTIONS``."""
    if name in SPEED_FACTORS:
        return 1.0 / (SPEED_FACTORS[name] * value)
    return value / FLUX_FACTORS[name]


def figure(name: str, emf_constant_v_s: float) -> float:
    """Invert :func:`emf_constant`."""
    if name in SPEED_FACTORS:
        return 1.0 / (SPEED_FACTORS[name] * emf_constant_v_s)
    return emf_constant_v_s * FLUX_FACTORS[name]


def agree_within(one: float, other: float, within: float) -> bool:
    """Return True if two figures > 0 differ by no more than a share of ``within``."""
    return abs(math.log(one / other)) <= math.log1p(within)


def kind_of(name: str) -> str:
    """Return kt, ke or kv."""
    return name[:2]


def explained(first: str, one: float, second: str, other: float) -> str:
    """Return readings of one of the two that make them agree, best first; each keeps its kind."""
    sides = ((first, one, emf_constant(second, other)), (second, other, emf_constant(first, one)))
    readings = sorted(
        (abs(math.log(emf_constant(reading, value) / fixed)), f"{reading} = {value:g}")
        for name, value, fixed in sides
        for reading in CONVENTIONS
        if reading != name and kind_of(reading) == kind_of(name)
        if agree_within(emf_constant(reading, value), fixed, AGREEING)
    )
    return f"they agree if {' or '.join(text for _, text in readings)} is meant" if readings else ""
