"""The firmware of the simulated drive: field-oriented current control on a fixed grid, and its set-points.

The inner grid starts at power-on: tick k is at ``k / inner_rate_hz``. At a tick the firmware samples the
currents and the encoder, computes the next voltage, and the inverter applies it from the next tick on:

    tick      k              k+1             k+2
              sample, compute --> voltage of k acts in the stator's frame
    Park angle for it: encoder angle at k, turned on by 1.5 periods

Current loops: PI with pole cancellation (bandwidth alpha: gains alpha L and alpha R), decoupling and back-EMF
feed-forward, i_d held at zero, voltage circle with d first. Torque set-point -> i_q = T / (k n_p phi).
Speed loop: for ramps to rest. Time is the caller's: ``advance_to`` runs the ticks up to an instant.
"""

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from servobench.design.iron import Iron
from servobench.design.motor import UNHEATED, PmsmParameters
from servobench.design.statespace import StateSpace
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.virtual_bus.core.native import InnerLoops
from servobench.virtual_bus.drive.current_controller import (
    check_controller,
    current_bandwidth_hz,
    fill_controllers,
)
from servobench.virtual_bus.drive.damage import Damage
from servobench.virtual_bus.drive.encoder import (
    BY_DIFFERENCE,
    Encoder,
    SpeedSensing,
    check_encoder,
    count_rad_s,
    fill_encoder,
)
from servobench.virtual_bus.drive.load_object import LoadTable
from servobench.virtual_bus.drive.mechanism import (
    NO_FIELD,
    FieldOptions,
    fill_field,
    fill_mechanism,
    speed_without_load_rad_s,
    steps_in,
    torque_limit_nm,
)
from servobench.virtual_bus.drive.power_stage import (
    IDEAL_INVERTER,
    CurrentSensors,
    Inverter,
    Protection,
    Supply,
    fill_power_stage,
    peak_current_a,
)
from servobench.virtual_bus.drive.set_point_path import STRAIGHT, SetPointPath, check_path, fill_path

_STEP_ANGLE_MAX = 0.25
"""Largest (R/L + electrical speed) * step, rad: keeps the error of a step below 1e-5 of the signal."""
_OVERSPEED = 2.0
"""The step is chosen for this multiple of the rated speed."""


def fill_machine(
    inner: InnerLoops, motor: PmsmParameters, period_s: float, fastest_rad_s: float = 0.0
) -> None:
    """Give ``inner`` the motor and the number of integration steps per ``period_s``, up to twice its rated
    speed; a drive that weakens the field takes more above it, up to ``fastest_rad_s``.

    The core integrates the equations of :mod:`servobench.design.motor`, in the rotor's dq frame, with the
    mechanics. Coulomb friction holds a resting shaft until the other torques exceed it. The load torque is an
    active one: it acts against positive speed whether the shaft turns or not. The position counts turns
    without end.
    """
    inner.resistance_ohm = motor.resistance_ohm
    inner.inductance_d_h = motor.inductance_d_h
    inner.inductance_q_h = motor.inductance_q_h
    inner.flux_linkage_wb = motor.flux_linkage_wb
    inner.pole_pairs = motor.pole_pairs
    inner.torque_factor = motor.torque_factor
    inner.inertia_kg_m2 = motor.inertia_kg_m2
    inner.viscous_friction_nm_s = motor.viscous_friction_nm_s
    inner.coulomb_friction_nm = motor.coulomb_friction_nm
    inner.voltage_max_v = motor.voltage_max_v
    inner.per_inductance_d = 1.0 / motor.inductance_d_h
    inner.per_inductance_q = 1.0 / motor.inductance_q_h
    inner.per_inertia = 1.0 / motor.inertia_kg_m2
    inner.period_s = period_s
    per_inductance = 1.0 / min(motor.inductance_d_h, motor.inductance_q_h)
    if motor.iron is not None:
        per_inductance = fill_iron(inner, motor, motor.iron)
    if motor.mechanism is not None:
        fill_mechanism(inner, motor, motor.mechanism)
    calm_rad_s = _OVERSPEED * motor.rated_speed_rad_s
    # the core tells it as a real number, which compiled code refuses where the whole one was set
    steps = _steps(motor, period_s, per_inductance, calm_rad_s)
    inner.substeps, inner.step_s = steps, period_s / steps
    inner.field_calm_rad_s, inner.field_calm_steps = calm_rad_s, steps
    inner.field_fast_steps = _steps(motor, period_s, per_inductance, max(calm_rad_s, fastest_rad_s))
    inner.per_period = 1.0 / period_s
    inner.torque_constant_nm_a = motor.torque_constant_nm_a
    inner.per_torque_constant = 1.0 / motor.torque_constant_nm_a


def _steps(motor: PmsmParameters, period_s: float, per_inductance: float, speed_rad_s: float) -> int:
    """How many steps of integration a period takes up to a speed; ``per_inductance``: 1/H."""
    angular_rad_s = motor.resistance_ohm * per_inductance + motor.pole_pairs * speed_rad_s
    steps = max(1, math.ceil(period_s * angular_rad_s / _STEP_ANGLE_MAX))
    return max(
        steps, 1 if motor.mechanism is None else steps_in(period_s, motor.mechanism, motor.inertia_kg_m2)
    )


def fill_iron(inner: InnerLoops, motor: PmsmParameters, iron: Iron) -> float:
    """Give ``inner`` iron that saturates; return the largest slope of a current over its flux, 1/H."""
    inner.saturated = 1
    inner.saturation_per_d, inner.saturation_per_q = iron.per_inductance_d, iron.per_inductance_q
    inner.saturation_magnet_a = motor.flux_linkage_wb * iron.per_inductance_d
    inner.saturation_knee_wb2, inner.saturation_strength = iron.knee_wb2, iron.strength
    corners = ((0.0, motor.current_max_a), (motor.current_max_a, 0.0))
    return max(max(iron.stiffness(*iron.fluxes(*corner))) for corner in corners)


_REST_SPEED_RAD_S: Final = 0.5
"""5 rpm, which a stop calls standstill; of an encoder whose counts make more, what they make."""
_COUNTS_AT_REST: Final = 1.5
"""What a flicker of so many counts makes of the speed still passes for rest."""

_MOTION_RATE_HZ: Final = 1000
"""Profiles and the position loop run this often, or at the inner rate if that is slower."""


class InnerControl(Enum):
    """Quantity followed by the inner loops."""

    OFF = 0
    """Inverter off; the holding brake closes once the shaft is slow."""
    TORQUE = 1
    SPEED = 2


@dataclass(frozen=True, slots=True)
class FirmwareParameters:
    """How the inner loops of a drive are set."""

    inner_rate_hz: int = 16_000
    encoder_counts_per_revolution: int = 65_536
    current_bandwidth_hz: float | None = None
    """None: a twentieth of the inner rate."""
    speed_bandwidth_hz: float = 30.0
    speed_limit_bandwidth_hz: float = 100.0
    """How fast the torque is taken back in front of the speed limit: inertia * 2 pi * this, N m s/rad."""
    encoder: Encoder | None = None
    """Its errors; None: none."""
    speed: SpeedSensing = BY_DIFFERENCE
    """How counts are made into 606Ch."""
    brake_torque_nm: float | None = None
    """Holding brake; None: twice the motor's rated torque, 0: no brake."""
    brake_open_s: float = 0.0
    """From the power stage's switching on until the brake lets go."""
    brake_close_s: float = 0.0
    """From its switching off, or standstill where that comes later, until the brake holds."""
    brake_waits: bool = False
    """The drive holds its shaft until the brake has opened, or has closed."""
    brake_output: bool = False
    """It has 60FEh."""
    controller_d: StateSpace | None = None
    """Replaces the PI on i_d: from its error, A, to the voltage, V, at the inner rate."""
    controller_q: StateSpace | None = None
    resistance_factor: float = 1.0
    """The turning motor's resistance beside the one that the drive was set for."""
    inductance_factor: float = 1.0
    supply: Supply | None = None
    """None: a DC link without end at the motor's ``dc_bus_voltage_v``."""
    protection: Protection | None = None
    """None: nothing of the power stage is watched."""
    inverter: Inverter = IDEAL_INVERTER
    path: SetPointPath = STRAIGHT
    """The way of cyclic set-points into the loops."""
    current_sensors: CurrentSensors | None = None
    """None: the currents are known as they are."""
    field: FieldOptions = NO_FIELD
    machine: PmsmParameters | None = None
    """The motor that turns; None: the one that the drive was set for. Both have the same transform and pole
    pairs."""

    def __post_init__(self) -> None:
        """Error: ValueError for a setting with which the loops could not work."""
        if not 1_000 <= self.inner_rate_hz <= 100_000:
            raise ValueError(f"inner_rate_hz {self.inner_rate_hz}: 1000..100000 expected")
        counts = self.encoder_counts_per_revolution
        if not 16 <= counts <= 1 << 30:
            raise ValueError(f"encoder_counts_per_revolution {counts}: 16..2**30 expected")
        if not 0.0 < self.current_hz <= self.inner_rate_hz / 8:
            raise ValueError(f"current_bandwidth_hz {self.current_hz}: at most inner_rate_hz / 8 expected")
        check_controller(self.controller_d, self.inner_rate_hz)
        check_controller(self.controller_q, self.inner_rate_hz)
        if not (self.resistance_factor > 0.0 and self.inductance_factor > 0.0):
            raise ValueError("resistance_factor and inductance_factor: more than 0 expected")
        if not 0.0 <= self.inverter.dead_time_s * self.inner_rate_hz <= 0.5:
            expected = f"at most half an inner period, {5e5 / self.inner_rate_hz:g} us, expected"
            raise ValueError(f"dead time {self.inverter.dead_time_s * 1e6:g} us: {expected}")
        if (
            self.current_sensors is not None
            and not 0.0 <= self.current_sensors.delay_s * self.inner_rate_hz <= 1.0
        ):
            expected = f"at most an inner period, {1e6 / self.inner_rate_hz:g} us, expected"
            raise ValueError(f"current sensor's delay {self.current_sensors.delay_s * 1e6:g} us: {expected}")
        check_encoder(self.inner_rate_hz, self.encoder, self.speed)
        check_path(self.inner_rate_hz, self.path)

    @property
    def current_hz(self) -> float:
        """Bandwidth of the current loops, Hz."""
        return current_bandwidth_hz(self.current_bandwidth_hz, self.inner_rate_hz)


class Firmware:
    """The inner loops with the motor behind them; the cyclic path reads and calls ``inner`` directly."""

    def __init__(self, motor: PmsmParameters, parameters: FirmwareParameters) -> None:
        self.motor = motor
        self.parameters = parameters
        self.inner = InnerLoops()
        self.advance_to = self.inner.advance_to
        """Run every tick up to and including an instant; False if there was none."""
        self._demand_torque = self.inner.demand_torque
        self.motion_ticks = max(1, parameters.inner_rate_hz // _MOTION_RATE_HZ)
        """Inner ticks of a motion period; the grid of these starts at power-on too."""
        self.tick_s = 1.0 / parameters.inner_rate_hz
        self.counts_per_rad = parameters.encoder_counts_per_revolution / math.tau
        self.speed_bandwidth_rad_s = math.tau * parameters.speed_bandwidth_hz
        self.inner.rate_hz, self.inner.motion_ticks = parameters.inner_rate_hz, self.motion_ticks
        self.machine = self._turning()
        """The motor that turns."""
        weakens = parameters.field.voltage_share > 0.0
        fastest_rad_s = speed_without_load_rad_s(motor, parameters.field) if weakens else 0.0
        fill_machine(self.inner, self.machine, self.tick_s, fastest_rad_s)
        fill_power_stage(
            self.inner,
            self.machine,
            self.tick_s,
            parameters.supply,
            parameters.protection,
            parameters.inverter,
            parameters.current_sensors,
        )
        fill_path(self.inner, parameters.path, self.tick_s)
        fill_controllers(self.inner, parameters.controller_d, parameters.controller_q)
        self._set_gains()
        self._set_limits()
        self.damage = Damage(self.inner, self.machine)

    def _turning(self) -> PmsmParameters:
        """The motor as it is; all that the drive reckons goes by the motor as it knows it."""
        parameters = self.parameters
        motor = parameters.machine or self.motor
        if (motor.transform, motor.pole_pairs) != (self.motor.transform, self.motor.pole_pairs):
            known = f"{self.motor.pole_pairs} pole pairs, {self.motor.transform.value}"
            raise ValueError(f"{motor.name}: {known} expected, as the drive was set for")
        heat = motor.heat or UNHEATED
        return replace(
            motor,
            flux_linkage_wb=motor.flux_linkage_wb * heat.flux_factor,
            viscous_friction_nm_s=motor.viscous_friction_nm_s * heat.viscous_factor,
            resistance_ohm=motor.resistance_ohm * parameters.resistance_factor * heat.resistance_factor,
            inductance_d_h=motor.inductance_d_h * parameters.inductance_factor,
            inductance_q_h=motor.inductance_q_h * parameters.inductance_factor,
        )

    def _set_gains(self) -> None:
        motor, parameters, inner = self.motor, self.parameters, self.inner
        period_s = 1.0 / parameters.inner_rate_hz
        alpha = math.tau * parameters.current_hz
        inner.decouple_d_h, inner.decouple_q_h = motor.inductance_d_h, motor.inductance_q_h
        inner.gain_d = alpha * motor.inductance_d_h
        inner.gain_q = alpha * motor.inductance_q_h
        inner.per_gain_d = 1.0 / inner.gain_d
        inner.per_gain_q = 1.0 / inner.gain_q
        inner.integral_gain = alpha * motor.resistance_ohm * period_s
        speed_alpha = math.tau * parameters.speed_bandwidth_hz
        inner.speed_gain = speed_alpha * motor.inertia_kg_m2
        inner.speed_integral_gain = speed_alpha * inner.speed_gain / 4.0
        inner.speed_limit_gain = math.tau * parameters.speed_limit_bandwidth_hz * motor.inertia_kg_m2
        fill_field(inner, motor, parameters.field, alpha)
        counts = parameters.encoder_counts_per_revolution
        fill_encoder(inner, counts, period_s, parameters.encoder, parameters.speed)
        flicker_rad_s = _COUNTS_AT_REST * count_rad_s(counts, period_s, parameters.speed)
        inner.rest_speed_rad_s = max(_REST_SPEED_RAD_S, flicker_rad_s)

    def _set_limits(self) -> None:
        rate_hz, brake = self.parameters.inner_rate_hz, self.parameters.brake_torque_nm
        self.inner.brake_open_ticks = round(rate_hz * self.parameters.brake_open_s)
        self.inner.brake_close_ticks = round(rate_hz * self.parameters.brake_close_s)
        self.inner.brake_nm = 2.0 * self.motor.rated_torque_nm if brake is None else brake
        self.limit(self.torque_max_nm, self.motor.current_max_a, math.inf)

    @property
    def torque_max_nm(self) -> float:
        """The largest torque that it can ask for."""
        return torque_limit_nm(self.motor, self.parameters.field)

    def start(self, now: Instant) -> None:
        """Power-on: the inner grid starts here. Call it before anything else."""
        assert self.ticks == 0, "the firmware has started already"
        self.inner.power_on_ns = now

    @property
    def ticks(self) -> int:
        """Since power-on."""
        return self.inner.ticks

    @property
    def tick_at(self) -> Instant:
        """The instant of the last tick, ns rounded down: when the actual values were sampled."""
        return Instant(self.inner.tick_at())

    def tick_after(self, now: Instant) -> Instant:
        """The instant of the next tick at or after ``now``, ns rounded up."""
        return Instant(self.inner.tick_after(now))

    def control(self, control: InnerControl) -> None:
        """Choose what the inner loops follow from the next tick on; the change is bumpless."""
        self.inner.wanted_control = control.value
        self.inner.asked = 1

    def demand_torque(self, torque_nm: float) -> None:
        """Torque set-point for ``InnerControl.TORQUE``."""
        self._demand_torque(torque_nm)

    def limit(
        self, torque_nm: float, current_a: float, speed_rad_s: float, down_nm: float | None = None
    ) -> None:
        """The limits of whatever is demanded; the current's is the peak of the drive's overload at most.
        ``down_nm``: that of negative torque; None: the same."""
        inner = self.inner
        inner.torque_up_nm = torque_nm
        inner.torque_down_nm = torque_nm if down_nm is None else down_nm
        inner.current_max_a = min(current_a, peak_current_a(self.motor, self.parameters.protection))
        inner.speed_max_rad_s = speed_rad_s
        inner.asked = 1

    def ramp_to_speed(self, speed_rad_s: float, acceleration_rad_s2: float, feed_nm: float = 0.0) -> None:
        """Follow a speed ramp from the present speed on; ``feed_nm`` is added to the speed loop's torque."""
        self.inner.ramp_to_speed(speed_rad_s, acceleration_rad_s2, feed_nm)

    @property
    def torque_demand_nm(self) -> float:
        """The demand in force now, inside its limits: a set-point counts from the instant at which it was
        written, the speed loop's demand from the tick that computed it."""
        return self.inner.torque_in_force()

    def brake_shaft(self, torque_nm: float) -> None:
        """Set the torque of an outside brake against the shaft's motion from the next tick on, N m."""
        self.inner.coulomb_friction_nm = self.machine.coulomb_friction_nm + torque_nm

    def bear(self, load: LoadTable | None, held: bool = False, begins_at: Instant | None = None) -> None:
        """Bear a load torque over time from the next tick on, its time 0 at ``begins_at``; None: that of the
        demand, which stays as it was at last. ``held``: as at the point before, not straight to the next."""
        if load is None:
            self.inner.bear(b"", b"", False, 0.0)
            return
        power_on_ns = self.inner.power_on_ns
        from_s = 0.0 if begins_at is None else (begins_at - power_on_ns) / NS_PER_S
        self.inner.bear(load.times_s, load.torques_nm, held, from_s)

    def hold_encoder(self, held: bool) -> None:
        """``held``: the encoder's line is broken, and from the next tick on its count stands still."""
        self.inner.encoder_held = held

    def scale_supply(self, share: float) -> float:
        """Set the source to that share of its voltage from the next tick on; return it, V."""
        inner, supply = self.inner, self.parameters.supply
        inner.source_v = share * (self.machine.dc_bus_voltage_v if supply is None else supply.voltage_v)
        if supply is None:
            inner.voltage_max_v = share * self.machine.voltage_max_v
        return inner.source_v

    @property
    def speed_rad_s(self) -> float:
        """True speed of the shaft, which no encoder has seen."""
        return self.inner.speed_rad_s

    def rested_for_s(self) -> float:
        """How long the shaft has been at rest at the end of a ramp to zero."""
        return self.inner.rest_ticks / self.inner.rate_hz
