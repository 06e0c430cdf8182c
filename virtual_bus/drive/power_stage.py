"""The power stage of a simulated drive: its DC link, and what it protects itself against.

The link: a source behind a resistance, the capacitor, a chopper with its resistor, and the inverter, which
takes what the motor turns into heat, field and motion, and gives back what braking returns. The largest
voltage of the motor follows the link's. Not in it: the ripple of a rectifier, losses of the switches, and a
motor that drives current through the diodes of an inverter that is off.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from servobench.design.motor import PmsmParameters, Transform
from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.virtual_bus.core.native import InnerLoops

_STEPS_PER_TIME_CONSTANT: Final = 10
"""Of resistors and capacitor: each step of the trapezoidal rule is then 1e-4 of a decay off."""


class Trip(IntEnum):
    """What the core's protection has found."""

    NONE = 0
    OVER_VOLTAGE = 1
    UNDER_VOLTAGE = 2
    OVER_CURRENT = 3
    OVERLOAD = 4
    MOTOR_HOT = 5
    ENCODER = 6
    STAGE_HOT = 7

    @property
    def opens(self) -> bool:
        """True if the power stage is off already, so that no ramp can follow."""
        return self not in (Trip.OVERLOAD, Trip.MOTOR_HOT, Trip.STAGE_HOT)


TRIP_CODES: Final = {
    Trip.OVER_VOLTAGE: (0x3210, ErrorRegister.VOLTAGE),
    Trip.UNDER_VOLTAGE: (0x3220, ErrorRegister.VOLTAGE),
    Trip.OVER_CURRENT: (0x2310, ErrorRegister.CURRENT),
    Trip.OVERLOAD: (0x2350, ErrorRegister.CURRENT),
    Trip.MOTOR_HOT: (0x4310, ErrorRegister.TEMPERATURE),
    Trip.STAGE_HOT: (0x4210, ErrorRegister.TEMPERATURE),
    Trip.ENCODER: (0x7305, ErrorRegister.DEVICE_PROFILE),
}
"""Error code 603Fh (CiA 402-2, 6.2.3) and its bit of 1001h."""


@dataclass(frozen=True, slots=True)
class Chopper:
    """A resistor that the link is switched to while its voltage is too high."""

    resistance_ohm: float
    on_v: float
    off_v: float


@dataclass(frozen=True, slots=True)
class Supply:
    """What feeds the drive."""

    voltage_v: float
    resistance_ohm: float
    capacitance_f: float
    feeds_back: bool = False
    """True: a battery or a regenerative unit; False: a rectifier, which blocks."""
    idle_w: float = 0.0
    """Taken by logic and gate drivers, also while the power stage is off."""
    chopper: Chopper | None = None


@dataclass(frozen=True, slots=True)
class Overload:
    """I^2 t above the continuous current; A rms of a phase."""

    continuous_a_rms: float
    peak_a_rms: float
    peak_time_s: float
    """For so long the peak current can flow, from a cold start."""
    warning_percent: float = 80.0
    clear_percent: float = 80.0
    """Of the sum, below which a limited current is free again."""
    trips: bool = False
    """True: the drive fails; False: it limits the current to the continuous one."""


@dataclass(frozen=True, slots=True)
class StageHeat:
    """Heat of the power stage, of first order by the current's square."""

    ambient_c: float
    rise_k: float
    """Above that for ever, at ``at_a_rms``."""
    at_a_rms: float
    time_constant_s: float
    max_c: float
    """Above it the drive fails."""
    clear_c: float
    """Below it the drive is well again."""
    derate_from_c: float | None = None
    """From there on its largest current falls, to 0 at ``max_c``; None: it does not."""


@dataclass(frozen=True, slots=True)
class Protection:
    """Limits of the power stage; None: not watched."""

    over_voltage_v: float | None = None
    under_voltage_v: float | None = None
    over_current_a_rms: float | None = None
    overload: Overload | None = None
    winding_max_c: float | None = None
    missing_counts_max: int | None = None
    """Encoder counts that may be missing between two index pulses."""
    stage: StageHeat | None = None
    """Its temperature; None: it stays cold."""


@dataclass(frozen=True, slots=True)
class CurrentSensors:
    """In phases a and b, between motor and drive; A of a phase, peak."""

    range_a: float
    """Larger currents are told as that."""
    bits: int | None = None
    """Resolution of the converter over twice the range; None: without steps."""
    gain_error_a: float = 0.0
    gain_error_b: float = 0.0
    offset_a: float = 0.0
    """A, of the sensor in phase a."""
    offset_b: float = 0.0
    noise_a_rms: float = 0.0
    delay_s: float = 0.0
    """Age of the current when the drive has it, an inner period at most."""


@dataclass(frozen=True, slots=True)
class Inverter:
    """Half bridges that switch once an inner period."""

    dead_time_s: float = 0.0
    """After the drive's own compensation."""
    zero_band_a: float = 0.0
    """Peak of the ripple: a smaller current of a phase loses in proportion, A."""
    output_share: float = 1.0
    """Share of the voltage circle that is used."""


IDEAL_INVERTER: Final = Inverter()
"""The default of a simulated drive."""


def current_per_rms(motor: PmsmParameters) -> float:
    """The amplitude in the motor's transform of 1 A rms of a phase."""
    return math.sqrt(3.0 if motor.transform is Transform.POWER_INVARIANT else 2.0)


def peak_current_a(motor: PmsmParameters, protection: Protection | None) -> float:
    """The largest amplitude that the drive lets flow, in the motor's transform; inf: any."""
    overload = None if protection is None else protection.overload
    return math.inf if overload is None else current_per_rms(motor) * overload.peak_a_rms


def fill_power_stage(
    inner: InnerLoops,
    motor: PmsmParameters,
    period_s: float,
    supply: Supply | None,
    protection: Protection | None,
    inverter: Inverter,
    sensors: CurrentSensors | None,
) -> None:
    """Give ``inner`` link, protection, inverter and current sensors."""
    inner.phase_amplitude = math.sqrt(2.0) / current_per_rms(motor)
    inner.dead_share = inverter.dead_time_s / period_s
    inner.zero_band_a = inverter.zero_band_a
    inner.output_share = inverter.output_share
    if sensors is not None:
        _fill_sensors(inner, sensors)
        inner.sensor_delay_share = sensors.delay_s / period_s
    inner.source_v = motor.dc_bus_voltage_v
    if supply is not None:
        _fill_link(inner, motor, period_s, supply)
    if protection is not None:
        _fill_protection(inner, current_per_rms(motor), period_s, protection, motor.current_max_a)


def _fill_sensors(inner: InnerLoops, sensors: CurrentSensors) -> None:
    inner.sensors = 1
    inner.sensor_range_a = sensors.range_a
    inner.sensor_step_a = 0.0 if sensors.bits is None else 2.0 * sensors.range_a / 2.0**sensors.bits
    inner.sensor_scale_a, inner.sensor_scale_b = 1.0 + sensors.gain_error_a, 1.0 + sensors.gain_error_b
    inner.sensor_offset_a, inner.sensor_offset_b = sensors.offset_a, sensors.offset_b
    inner.sensor_noise_a = sensors.noise_a_rms


def _fill_link(inner: InnerLoops, motor: PmsmParameters, period_s: float, supply: Supply) -> None:
    siemens = 1.0 / supply.resistance_ohm
    inner.source_siemens = siemens
    inner.source_v = inner.link_v = supply.voltage_v
    inner.capacitance_f = supply.capacitance_f
    inner.feeds_back = supply.feeds_back
    inner.idle_w = supply.idle_w
    inner.chopper_on_v = math.inf
    if supply.chopper is not None:
        inner.chopper_siemens = 1.0 / supply.chopper.resistance_ohm
        siemens += inner.chopper_siemens
        inner.chopper_on_v, inner.chopper_off_v = supply.chopper.on_v, supply.chopper.off_v
    inner.circle_share = motor.voltage_max_v / motor.dc_bus_voltage_v
    steps = max(1, math.ceil(_STEPS_PER_TIME_CONSTANT * period_s * siemens / supply.capacitance_f))
    inner.link_steps = steps
    inner.link_step_s = period_s / steps
    inner.supplied = 1


def _fill_protection(
    inner: InnerLoops, per_rms: float, period_s: float, protection: Protection, current_max_a: float
) -> None:
    def of(limit: float | None) -> float:
        return math.inf if limit is None else limit

    inner.over_v = of(protection.over_voltage_v)
    inner.under_v = protection.under_voltage_v or 0.0
    inner.over_a2 = (per_rms * of(protection.over_current_a_rms)) ** 2
    inner.winding_max_c = of(protection.winding_max_c)
    inner.missing_max = of(protection.missing_counts_max)
    inner.overload_max_a2s = inner.warning_a2s = math.inf
    inner.watch_period_s = period_s
    overload = protection.overload
    if overload is not None:
        inner.continuous_a = per_rms * overload.continuous_a_rms
        inner.continuous_a2 = inner.continuous_a**2
        above_a2 = (per_rms * overload.peak_a_rms) ** 2 - inner.continuous_a2
        inner.overload_max_a2s = above_a2 * overload.peak_time_s
        inner.warning_a2s = overload.warning_percent / 100.0 * inner.overload_max_a2s
        inner.clear_a2s = overload.clear_percent / 100.0 * inner.overload_max_a2s
        inner.overload_trips = overload.trips
    if protection.stage is not None:
        most_a = min(current_max_a, per_rms * (math.inf if overload is None else overload.peak_a_rms))
        _fill_stage(inner, protection.stage, per_rms, period_s, most_a)
    inner.protected = 1


def _fill_stage(inner: InnerLoops, stage: StageHeat, per_rms: float, period_s: float, most_a: float) -> None:
    """``most_a``: amplitude that it lets through while it is cold."""
    inner.stage_heats = 1
    inner.stage_c = inner.ambient_c = stage.ambient_c
    inner.stage_share = period_s / stage.time_constant_s
    inner.rise_k_a2 = stage.rise_k / (per_rms * stage.at_a_rms) ** 2
    inner.stage_max_c, inner.stage_clear_c = stage.max_c, stage.clear_c
    inner.derate_from_c = math.inf
    if stage.derate_from_c is not None:
        inner.derate_from_c = stage.derate_from_c
        inner.derate_a_k = most_a / (stage.max_c - stage.derate_from_c)
