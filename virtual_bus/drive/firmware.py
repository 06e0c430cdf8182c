"""What runs inside the simulated drive: field-oriented current control on a fixed grid, and its set-points.

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
from typing import Final, cast

import numpy as np

from design.motor import PmsmParameters
from design.statespace import StateSpace
from drivers.timebase import NS_PER_S, Instant
from virtual_bus.drive import motor_kernel as kernel
from virtual_bus.drive.current_bandwidth import current_bandwidth_hz
from virtual_bus.drive.current_controller import check_controller, fill_controllers
from virtual_bus.drive.load_table import LoadTable, fill_loads
from virtual_bus.drive.motor_kernel import FloatArray

_STEP_ANGLE_MAX = 0.25
"""Largest (R/L + electrical speed) * step, rad: keeps the error of a step below 1e-5 of the signal."""
_OVERSPEED = 2.0
"""The step is chosen for this multiple of the rated speed."""


def fill_machine(p: FloatArray, motor: PmsmParameters, period_s: float) -> None:
    """Write the motor and the number of integration steps per ``period_s`` into ``p``, (PARAMETERS_SIZE,).

    The kernel integrates the equations of :mod:`design.motor`, in the rotor's dq frame, with the mechanics.
    Coulomb friction holds a resting shaft until the other torques exceed it. The load torque is an active
    one: it acts against positive speed whether the shaft turns or not. The position counts turns without end.
    """
    p[kernel.P_RESISTANCE] = motor.resistance_ohm
    p[kernel.P_INDUCTANCE_D] = motor.inductance_d_h
    p[kernel.P_INDUCTANCE_Q] = motor.inductance_q_h
    p[kernel.P_FLUX] = motor.flux_linkage_wb
    p[kernel.P_POLE_PAIRS] = motor.pole_pairs
    p[kernel.P_TORQUE_FACTOR] = motor.torque_factor
    p[kernel.P_INERTIA] = motor.inertia_kg_m2
    p[kernel.P_VISCOUS] = motor.viscous_friction_nm_s
    p[kernel.P_COULOMB] = motor.coulomb_friction_nm
    p[kernel.P_VOLTAGE_MAX] = motor.voltage_max_v
    p[kernel.P_PER_INDUCTANCE_D] = 1.0 / motor.inductance_d_h
    p[kernel.P_PER_INDUCTANCE_Q] = 1.0 / motor.inductance_q_h
    p[kernel.P_PER_INERTIA] = 1.0 / motor.inertia_kg_m2
    p[kernel.P_PERIOD] = period_s
    fastest_rad_s = motor.resistance_ohm / min(motor.inductance_d_h, motor.inductance_q_h)
    fastest_rad_s += _OVERSPEED * motor.pole_pairs * motor.rated_speed_rad_s
    substeps = max(1, math.ceil(period_s * fastest_rad_s / _STEP_ANGLE_MAX))
    p[kernel.P_SUBSTEPS] = substeps
    p[kernel.P_STEP] = period_s / substeps
    p[kernel.P_RATE] = 1.0 / period_s
    p[kernel.P_TORQUE_CONSTANT] = motor.torque_constant_nm_a
    p[kernel.P_PER_TORQUE_CONSTANT] = 1.0 / motor.torque_constant_nm_a


_REST_SPEED_RAD_S: Final = 0.5
"""5 rpm, which a stop calls standstill; of an encoder whose counts make more, what they make."""
_COUNTS_AT_REST: Final = 1.5
"""Encoder counts per inner period that still pass for rest: the last count may flicker."""

_advance_drive: Final = kernel.advance_drive
_torque_demand: Final = kernel.torque_demand
_NO_LOADS: Final = np.zeros(0)
_TORQUE: Final = int(kernel.D_TORQUE)
_CONTROL: Final = int(kernel.D_CONTROL)
_TORQUE_MAX: Final = int(kernel.D_TORQUE_MAX)
_CURRENT_MAX: Final = int(kernel.D_CURRENT_MAX)
_SPEED_MAX: Final = int(kernel.D_SPEED_MAX)
_SPEED: Final = int(kernel.D_SPEED)
_ACCELERATION: Final = int(kernel.D_ACCELERATION)
_TORQUE_FEED: Final = int(kernel.D_TORQUE_FEED)
_TORQUE_IN_FORCE: Final = int(kernel.S_TORQUE_DEMAND)
_CONTROL_OFF: Final = float(kernel.CONTROL_OFF)
_CONTROL_TORQUE: Final = float(kernel.CONTROL_TORQUE)
_CONTROL_SPEED: Final = float(kernel.CONTROL_SPEED)
_LOADS_AT_ONCE: Final = 256
"""Inner periods: the loads of the next 16 ms are looked up in one call, which costs as much as a tick."""
_MOTION_RATE_HZ: Final = 1000
"""Profiles and the position loop run this often, or at the inner rate if that is slower."""


class InnerControl(Enum):
    """What the inner loops follow."""

    OFF = kernel.CONTROL_OFF
    """Inverter off; the holding brake closes once the shaft is slow."""
    TORQUE = kernel.CONTROL_TORQUE
    SPEED = kernel.CONTROL_SPEED


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
    speed_filter_hz: float = 500.0
    """Corner of the first-order filter behind the encoder's count difference."""
    brake_torque_nm: float | None = None
    """Holding brake; None: twice the motor's rated torque, 0: no brake."""
    controller_d: StateSpace | None = None
    """What takes the place of the PI on i_d: from its error, A, to the voltage, V, at the inner rate."""
    controller_q: StateSpace | None = None
    resistance_factor: float = 1.0
    """The turning motor's resistance beside the one that the drive was set for."""
    inductance_factor: float = 1.0

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
        if not self.speed_filter_hz > 0.0:
            raise ValueError(f"speed_filter_hz {self.speed_filter_hz}: more than 0 expected")

    @property
    def current_hz(self) -> float:
        """Bandwidth of the current loops, Hz."""
        return current_bandwidth_hz(self.current_bandwidth_hz, self.inner_rate_hz)


class Firmware:
    """The inner loops with the motor behind them.

    ``state`` and ``demand`` are the kernel's arrays (indices ``S_*`` and ``D_*``): the cyclic path reads the
    one and writes the other directly.
    """

    def __init__(self, motor: PmsmParameters, parameters: FirmwareParameters) -> None:
        self.motor = motor
        self.parameters = parameters
        self.state = np.zeros(kernel.STATE_SIZE)
        self.demand = np.zeros(kernel.DEMAND_SIZE)
        # Loads and stores of single numbers are cheaper by way of these.
        self._demand = cast("memoryview[float]", self.demand.data)
        self._state = cast("memoryview[float]", self.state.data)
        self.ticks = 0
        self._asked = True
        """Whether a demand was written since the last tick."""
        self._p = np.zeros(kernel.PARAMETERS_SIZE)
        self._power_on = Instant(0)
        self._rate_hz = parameters.inner_rate_hz
        self._load: LoadTable | None = None
        """That the shaft bears now."""
        self._loads = np.zeros(_LOADS_AT_ONCE)
        self._loads_end = 0
        """The first tick beyond those that the loads are looked up for."""
        self._load_held = False
        self._load_place = 0
        """Of the last point that was passed."""
        self._load_from_s = 0.0
        """Its time 0, counted from power-on."""
        self.motion_ticks = max(1, parameters.inner_rate_hz // _MOTION_RATE_HZ)
        """Inner ticks of a motion period; the grid of these starts at power-on too."""
        self.tick_s = 1.0 / parameters.inner_rate_hz
        self.counts_per_rad = parameters.encoder_counts_per_revolution / kernel.TURN
        self.speed_bandwidth_rad_s = kernel.TURN * parameters.speed_bandwidth_hz
        fill_machine(self._p, self._turning(), 1.0 / parameters.inner_rate_hz)
        fill_controllers(self._p, parameters.controller_d, parameters.controller_q)
        self._set_gains()
        self._set_limits()
        # Loaded or compiled now, not in the first cycle.
        kernel.advance_drive(self.state, self._p, self.demand, _NO_LOADS, 0, 0)
        kernel.torque_demand(self.state, self._p, self.demand)

    def _turning(self) -> PmsmParameters:
        """The motor as it is; gains and decoupling go by the motor as the drive knows it."""
        motor, parameters = self.motor, self.parameters
        return replace(
            motor,
            resistance_ohm=motor.resistance_ohm * parameters.resistance_factor,
            inductance_d_h=motor.inductance_d_h * parameters.inductance_factor,
            inductance_q_h=motor.inductance_q_h * parameters.inductance_factor,
        )

    def _set_gains(self) -> None:
        motor, parameters, p = self.motor, self.parameters, self._p
        period_s = 1.0 / parameters.inner_rate_hz
        alpha = kernel.TURN * parameters.current_hz
        p[kernel.P_DECOUPLE_D], p[kernel.P_DECOUPLE_Q] = motor.inductance_d_h, motor.inductance_q_h
        p[kernel.P_GAIN_D] = alpha * motor.inductance_d_h
        p[kernel.P_GAIN_Q] = alpha * motor.inductance_q_h
        p[kernel.P_PER_GAIN_D] = 1.0 / p[kernel.P_GAIN_D]
        p[kernel.P_PER_GAIN_Q] = 1.0 / p[kernel.P_GAIN_Q]
        p[kernel.P_INTEGRAL_GAIN] = alpha * motor.resistance_ohm * period_s
        p[kernel.P_SPEED_FILTER] = period_s / (period_s + 1.0 / (kernel.TURN * parameters.speed_filter_hz))
        speed_alpha = kernel.TURN * parameters.speed_bandwidth_hz
        p[kernel.P_SPEED_GAIN] = speed_alpha * motor.inertia_kg_m2
        p[kernel.P_SPEED_INTEGRAL_GAIN] = speed_alpha * p[kernel.P_SPEED_GAIN] / 4.0
        p[kernel.P_SPEED_LIMIT_GAIN] = kernel.TURN * parameters.speed_limit_bandwidth_hz * motor.inertia_kg_m2
        count_rad_s = kernel.TURN / parameters.encoder_counts_per_revolution / period_s
        p[kernel.P_REST_SPEED] = max(
            _REST_SPEED_RAD_S, _COUNTS_AT_REST * p[kernel.P_SPEED_FILTER] * count_rad_s
        )
        p[kernel.P_COUNTS] = parameters.encoder_counts_per_revolution
        p[kernel.P_COUNTS_PER_RAD] = parameters.encoder_counts_per_revolution / kernel.TURN
        p[kernel.P_RAD_PER_COUNT] = kernel.TURN / parameters.encoder_counts_per_revolution

    def _set_limits(self) -> None:
        brake = self.parameters.brake_torque_nm
        self._p[kernel.P_BRAKE] = 2.0 * self.motor.rated_torque_nm if brake is None else brake
        self.limit(self.motor.torque_max_nm, self.motor.current_max_a, math.inf)

    def start(self, now: Instant) -> None:
        """Power-on: the inner grid starts here. Call it before anything else."""
        assert self.ticks == 0, "the firmware has started already"
        self._power_on = now

    def advance_to(self, now: Instant) -> bool:
        """Run every tick up to and including ``now``; False if there was none."""
        due = (now - self._power_on) * self._rate_hz // NS_PER_S - self.ticks
        if due <= 0:
            return False
        self._run(due)
        return True

    def advance_to_motion_tick(self, now: Instant) -> bool:
        """Run the ticks up to the next of the motion grid, or to ``now`` if that comes first; whether the
        grid was reached."""
        due = (now - self._power_on) * self._rate_hz // NS_PER_S - self.ticks
        missing = self.motion_ticks - self.ticks % self.motion_ticks
        ticks = min(due, missing)
        if ticks > 0:
            self._run(ticks)
        return due >= missing

    def _run(self, ticks: int) -> None:
        self._asked = False
        if self._load is None:
            _advance_drive(self.state, self._p, self.demand, _NO_LOADS, 0, ticks)
            self.ticks += ticks
            return
        while ticks > 0:
            if self.ticks >= self._loads_end:
                self._fill_loads(self._load, _LOADS_AT_ONCE)
            part = min(ticks, self._loads_end - self.ticks)
            place = self.ticks + _LOADS_AT_ONCE - self._loads_end
            _advance_drive(self.state, self._p, self.demand, self._loads, place, part)
            self.ticks += part
            ticks -= part

    def _fill_loads(self, load: LoadTable, ticks: int) -> None:
        """Of the next periods; each period's is that of its middle."""
        at_s = (self.ticks + 0.5) * self.tick_s - self._load_from_s
        times_s, torques_nm, held = load.times_s, load.torques_nm, self._load_held
        self._load_place = fill_loads(
            self._loads, times_s, torques_nm, held, at_s, self.tick_s, ticks, self._load_place
        )
        self._loads_end = self.ticks + ticks

    @property
    def tick_at(self) -> Instant:
        """The instant of the last tick, ns rounded down: when the actual values were sampled."""
        return Instant(self._power_on + self.ticks * NS_PER_S // self._rate_hz)

    def tick_after(self, now: Instant) -> Instant:
        """The instant of the next tick at or after ``now``, ns rounded up."""
        ticks = -((self._power_on - now) * self._rate_hz // NS_PER_S)
        return Instant(self._power_on - (-ticks * NS_PER_S // self._rate_hz))

    def control(self, control: InnerControl) -> None:
        """Choose what the inner loops follow from the next tick on; the change is bumpless."""
        self._demand[_CONTROL] = control.value
        self._asked = True

    def demand_torque(self, torque_nm: float) -> None:
        """Torque set-point for ``InnerControl.TORQUE``."""
        self._demand[_TORQUE] = torque_nm
        self._asked = True

    def limit(self, torque_nm: float, current_a: float, speed_rad_s: float) -> None:
        """The limits of whatever is demanded."""
        demand = self._demand
        demand[_TORQUE_MAX] = torque_nm
        demand[_CURRENT_MAX] = current_a
        demand[_SPEED_MAX] = speed_rad_s
        self._asked = True

    def ramp_to_speed(self, speed_rad_s: float, acceleration_rad_s2: float, feed_nm: float = 0.0) -> None:
        """Follow a speed ramp from the present speed on; ``feed_nm`` is added to the speed loop's torque."""
        demand = self._demand
        demand[_SPEED] = speed_rad_s
        demand[_ACCELERATION] = acceleration_rad_s2
        demand[_TORQUE_FEED] = feed_nm
        demand[_CONTROL] = _CONTROL_SPEED
        self._asked = True

    @property
    def torque_demand_nm(self) -> float:
        """The demand in force now, inside its limits: a set-point counts from the instant at which it was
        written, the speed loop's demand from the tick that computed it."""
        control = self._demand[_CONTROL]
        if control == _CONTROL_TORQUE and self._asked:
            return float(_torque_demand(self.state, self._p, self.demand))
        return 0.0 if control == _CONTROL_OFF else self._state[_TORQUE_IN_FORCE]

    def brake_shaft(self, torque_nm: float) -> None:
        """What an outside brake holds against the shaft's motion from the next tick on, N m."""
        self._p[kernel.P_COULOMB] = self.motor.coulomb_friction_nm + torque_nm

    def bear(self, load: LoadTable | None, held: bool = False, begins_at: Instant | None = None) -> None:
        """Bear a load torque over time from the next tick on, its time 0 at ``begins_at``; None: that of the
        demand, which stays as it was at last. ``held``: as at the point before, not straight to the next."""
        self._load, self._load_held, self._load_place = load, held, 0
        if load is not None:
            self._load_from_s = ((begins_at or self._power_on) - self._power_on) / NS_PER_S
            self._fill_loads(load, 0)  # loaded or compiled now, not in the first cycle under it

    def hold_encoder(self, held: bool) -> None:
        """``held``: the encoder's line is broken, and from the next tick on its count stands still."""
        self._p[kernel.P_ENCODER_HELD] = float(held)

    @property
    def speed_rad_s(self) -> float:
        """True speed of the shaft, which no encoder has seen."""
        return float(self.state[kernel.S_SPEED])

    def rested_for_s(self) -> float:
        """How long the shaft has been at rest at the end of a ramp to zero."""
        return float(self.state[kernel.S_REST_TICKS]) / self._rate_hz
