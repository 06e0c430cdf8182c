"""Files of simulated drives: their source, ``[supply]``, limits of their power stage, ``[protection]``,
their ``[inverter]``, ``[current_sensor]``, ``[encoder]``, ``[current_loop]``, ``[brake]``,
``[timing]``, ``[set_point]`` and ``[field]``.

``like`` of ``[drive.NAME.simulation]`` names one or a preset, or has its tables.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from servobench.design.motor import PmsmParameters
from servobench.drivers.bounded_file import NamedBy
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.drive_protection import ProtectionTable
from servobench.hil.configuration.drive_timing import SetPointTable, TimingTable
from servobench.hil.configuration.preset_files import FromPreset, load_file_or_preset
from servobench.hil.configuration.quantities import Current, Resistance, Voltage
from servobench.virtual_bus.device.device_options import AT_ONCE
from servobench.virtual_bus.drive.encoder import Encoder, SineErrors, SpeedMethod, SpeedSensing
from servobench.virtual_bus.drive.mechanism import FieldOptions
from servobench.virtual_bus.drive.power_stage import (
    Chopper,
    CurrentSensors,
    Inverter,
    Supply,
    peak_current_a,
)
from servobench.virtual_bus.drive.set_point_path import STRAIGHT

_TIME_CONSTANT_MIN_S = 1e-5
"""Of resistance and capacitance: a period of 62.5 us is then cut into 63 steps."""
_UF = 1e-6


class ChopperTable(Section):
    """``[supply.chopper]``: a resistor that the link is switched to while its voltage is too high."""

    resistance_ohm: Resistance = Field(description="braking resistor, ohm")
    on_v: Voltage = Field(description="switched on at this voltage of the link, V")
    off_v: Voltage = Field(description="switched off at this, V")

    @model_validator(mode="after")
    def _check_hysteresis(self) -> Self:
        if self.off_v >= self.on_v:
            raise ValueError(f"off_v below on_v = {self.on_v:g}")
        return self


class SupplyTable(Section):
    """``[supply]``: the source in front of the drive, and the capacitor of its DC link."""

    voltage_v: Voltage = Field(description="of the DC link without load, V")
    resistance_ohm: Resistance = Field(default=0.5, description="between source and link, ohm")
    capacitance_uf: float = Field(default=1000.0, ge=1.0, le=1e7, description="of the DC link, uF")
    feeds_back: bool = Field(
        default=False, description="the source takes energy back, as a battery; else a rectifier blocks"
    )
    idle_w: float = Field(default=5.0, ge=0.0, le=1e4, description="of logic and gate drivers, W")
    chopper: ChopperTable | None = Field(default=None, description="the table [supply.chopper]")

    @model_validator(mode="after")
    def _check_link(self) -> Self:
        ohm = (
            self.resistance_ohm
            if self.chopper is None
            else min(self.resistance_ohm, self.chopper.resistance_ohm)
        )
        if ohm * self.capacitance_uf * _UF < _TIME_CONSTANT_MIN_S:
            raise ValueError(f"resistance times capacitance of at least {_TIME_CONSTANT_MIN_S / _UF:g} us")
        if self.chopper is not None and self.chopper.off_v <= self.voltage_v:
            raise ValueError(f"chopper.off_v above voltage_v = {self.voltage_v:g}, or it heats for ever")
        return self

    @property
    def parameters(self) -> Supply:
        """The supply of the simulated drive."""
        chopper = self.chopper
        return Supply(
            self.voltage_v,
            self.resistance_ohm,
            self.capacitance_uf * _UF,
            self.feeds_back,
            self.idle_w,
            None if chopper is None else Chopper(chopper.resistance_ohm, chopper.on_v, chopper.off_v),
        )


_SPEED_FILTER_HZ = 500.0
"""Of the difference of counts, which is told in steps of a count a period without it."""
_METHODS = {
    "difference": SpeedMethod.DIFFERENCE,
    "edges": SpeedMethod.EDGES,
    "observer": SpeedMethod.OBSERVER,
}
OffsetPercent = Annotated[float, Field(ge=-20.0, le=20.0)]


class EncoderSpeedTable(Section):
    """``[encoder.speed]``: how the drive makes counts into 606Ch."""

    method: Literal["difference", "edges", "observer"] = "difference"
    """Counts of an inner period; the time between edges (M/T); a loop that follows the count."""
    filter_hz: float | None = Field(default=None, ge=1.0, le=50_000.0)
    """Corner of the first-order filter behind it; default: 500 of the difference, else no filter."""
    timer_ns: float = Field(default=10.0, ge=0.1, le=10_000.0)
    """Step of the timer of the edges."""
    bandwidth_rad_s: float = Field(default=1000.0, ge=1.0, le=4000.0)
    """Bandwidth of the observer."""

    @property
    def parameters(self) -> SpeedSensing:
        """The speed sensing of the simulated drive."""
        filter_hz = self.filter_hz
        if filter_hz is None and self.method == "difference":
            filter_hz = _SPEED_FILTER_HZ
        return SpeedSensing(_METHODS[self.method], filter_hz, 1e9 / self.timer_ns, self.bandwidth_rad_s)


class EncoderTable(Section):
    """``[encoder]``: the encoder of the motor, and its errors."""

    counts_per_revolution: int | None = Field(default=None, ge=16, le=2**30)
    """What the bench does not say by ``encoder_counts_per_revolution``."""
    lines: int = Field(default=1024, ge=1, le=1 << 20, description="signal periods of a turn")
    sine_offset_percent: OffsetPercent = 0.0
    """Share of the cosine's amplitude, as are the next two; 1 % makes up to 0.57 degrees of a line."""
    cosine_offset_percent: OffsetPercent = 0.0
    sine_gain_percent: OffsetPercent = 0.0
    """By how much the sine's amplitude exceeds the cosine's: an error twice a line."""
    quadrature_deg: float = Field(default=0.0, ge=-10.0, le=10.0)
    """By how much sine and cosine are further apart than 90 degrees of a line."""
    eccentricity_deg: float = Field(default=0.0, ge=0.0, le=10.0)
    """Amplitude of the error once a turn, degrees of the shaft."""
    eccentricity_phase_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    delay_us: float = Field(default=0.0, ge=0.0, le=62.5)
    """Age of the angle when the drive has it; at most an inner period."""
    speed: EncoderSpeedTable = EncoderSpeedTable()

    @property
    def parameters(self) -> Encoder | None:
        """The errors of the simulated drive's encoder; None: there are none."""
        sines = SineErrors(
            self.sine_offset_percent / 100.0,
            self.cosine_offset_percent / 100.0,
            self.sine_gain_percent / 100.0,
            math.radians(self.quadrature_deg),
        )
        encoder = Encoder(
            self.lines,
            None if sines == SineErrors() else sines,
            math.radians(self.eccentricity_deg),
            math.radians(self.eccentricity_phase_deg),
            self.delay_us * 1e-6,
        )
        return None if encoder == Encoder(self.lines) else encoder


GainPercent = Annotated[float, Field(ge=-20.0, le=20.0)]


class CurrentSensorTable(Section):
    """``[current_sensor]``: the sensors in phases a and b; the third current is what these leave."""

    range_a: Current = Field(description="largest current of a phase that they tell, A peak")
    bits: int | None = Field(default=None, ge=4, le=24)
    """Resolution of the converter over -range_a to range_a; default: without steps."""
    gain_error_a_percent: GainPercent = 0.0
    """By how much the current of phase a is told too large."""
    gain_error_b_percent: GainPercent = 0.0
    offset_a_percent: GainPercent = 0.0
    """What phase a tells of no current, of range_a."""
    offset_b_percent: GainPercent = 0.0
    noise_percent_rms: float = Field(default=0.0, ge=0.0, le=10.0)
    """Share of range_a, in each phase and each inner period."""
    delay_us: float = Field(default=0.0, ge=0.0, le=1000.0)
    """Age of a current when the drive has it, up to an inner period."""

    @property
    def parameters(self) -> CurrentSensors:
        """The current sensors of the simulated drive."""
        return CurrentSensors(
            self.range_a,
            self.bits,
            self.gain_error_a_percent / 100.0,
            self.gain_error_b_percent / 100.0,
            self.offset_a_percent / 100.0 * self.range_a,
            self.offset_b_percent / 100.0 * self.range_a,
            self.noise_percent_rms / 100.0 * self.range_a,
            self.delay_us * 1e-6,
        )


class InverterTable(Section):
    """``[inverter]``: half bridges that switch once an inner period."""

    dead_time_us: float = Field(default=0.0, ge=0.0, le=5.0)
    """Between the two switches of a half bridge; takes voltage by the sign of each phase's current."""
    compensated_percent: float = Field(default=0.0, ge=0.0, le=100.0)
    """Share of the dead time that the drive takes back."""
    zero_band_a: float = Field(default=0.1, ge=0.0, le=1000.0)
    """Peak of the ripple: a smaller current of a phase loses voltage in proportion, A."""
    output_percent: float = Field(default=100.0, ge=10.0, le=100.0)
    """Share of the largest voltage that the drive uses."""

    @property
    def parameters(self) -> Inverter:
        """The inverter of the simulated drive."""
        left = 1.0 - self.compensated_percent / 100.0
        return Inverter(left * self.dead_time_us * 1e-6, self.zero_band_a, self.output_percent / 100.0)


class BrakeTable(Section):
    """``[brake]``: the motor's holding brake, which closes at standstill once the power stage is off."""

    torque_nm: float | None = Field(default=None, ge=0.0, le=1e6)
    """Torque that it holds, at the rotor; default: twice the motor's rated torque."""
    open_ms: float = Field(default=0.0, ge=0.0, le=5_000.0)
    """From the power stage's switching on until it lets go."""
    close_ms: float = Field(default=0.0, ge=0.0, le=5_000.0)
    """From its switching off, or standstill where that comes later, until it holds."""
    drive_waits: bool = False
    """The drive holds its shaft at rest until the brake has opened, or closed, before it goes on."""

    @property
    def parameters(self) -> dict[str, float | None]:
        """Fields of the simulated drive."""
        return {
            "brake_torque_nm": self.torque_nm,
            "brake_open_s": self.open_ms / 1000.0,
            "brake_close_s": self.close_ms / 1000.0,
            "brake_waits": self.drive_waits,
            "brake_output": True,
        }


class CurrentLoopTable(Section):
    """``[current_loop]``: the period of current loops and inverter."""

    rate_hz: int = Field(ge=4000, le=64000, description="rate of the current loops, Hz")
    """What the bench does not say by ``inner_rate_hz``."""


class FieldTable(Section):
    """``[field]``: what the drive does besides a d current of zero, by the motor as it believes it."""

    least_current: bool = False
    """A d current that makes torque by saliency: the least amplitude for each torque (MTPA)."""
    weakening: bool = False
    """A negative d current where the voltage is used up."""
    voltage_percent: float = Field(default=95.0, ge=50.0, le=100.0)
    """Share of the largest voltage above which the field is weakened."""

    @property
    def parameters(self) -> FieldOptions:
        """The same for the simulated drive."""
        return FieldOptions(self.least_current, self.voltage_percent / 100.0 if self.weakening else 0.0)


class DriveModel(FromPreset):
    """A whole file of a simulated drive."""

    KIND: ClassVar[str] = "drives"

    supply: SupplyTable | None = Field(default=None, description="the table [supply]")
    protection: ProtectionTable | None = Field(default=None, description="the table [protection]")
    encoder: EncoderTable | None = Field(default=None, description="the table [encoder]")
    inverter: InverterTable | None = Field(default=None, description="the table [inverter]")
    current_sensor: CurrentSensorTable | None = Field(default=None, description="the table [current_sensor]")
    current_loop: CurrentLoopTable | None = Field(default=None, description="the table [current_loop]")
    brake: BrakeTable | None = Field(default=None, description="the table [brake]")
    timing: TimingTable | None = Field(default=None, description="the table [timing]")
    set_point: SetPointTable | None = Field(default=None, description="the table [set_point]")
    field: FieldTable = FieldTable()
    """The table [field]."""

    @property
    def rates(self) -> dict[str, int]:
        """Fields of the same that the bench has keys for, as far as they are said here."""
        found = {
            "inner_rate_hz": None if self.current_loop is None else self.current_loop.rate_hz,
            "encoder_counts_per_revolution": None
            if self.encoder is None
            else self.encoder.counts_per_revolution,
        }
        return {name: value for name, value in found.items() if value is not None}

    @property
    def parameters(self) -> dict[str, Any]:
        """Fields of :class:`servobench.virtual_bus.drive.servo_parameters.DriveParameters`."""
        encoder = EncoderTable() if self.encoder is None else self.encoder
        inverter = InverterTable() if self.inverter is None else self.inverter
        return {
            "supply": None if self.supply is None else self.supply.parameters,
            "protection": None if self.protection is None else self.protection.parameters,
            "inverter": inverter.parameters,
            "field": self.field.parameters,
            "current_sensors": None if self.current_sensor is None else self.current_sensor.parameters,
            "encoder": encoder.parameters,
            "speed": encoder.speed.parameters,
            **({} if self.brake is None else self.brake.parameters),
            "path": STRAIGHT if self.set_point is None else self.set_point.parameters,
            "tasks": AT_ONCE if self.timing is None else self.timing.parameters,
        }

    def runs(self, motor: PmsmParameters) -> PmsmParameters:
        """The motor as this drive can run it: at its link's voltage, as far as its output goes, with its peak
        current."""
        output = 1.0 if self.inverter is None else self.inverter.output_percent / 100.0
        volts = motor.dc_bus_voltage_v if self.supply is None else self.supply.voltage_v
        protection = None if self.protection is None else self.protection.parameters
        current_a = min(motor.current_max_a, peak_current_a(motor, protection))
        return replace(motor, dc_bus_voltage_v=output * volts, current_max_a=current_a)


def load_drive_model(path: Path, named_by: NamedBy | None = None) -> DriveModel:
    """Load the file of a simulated drive at ``path``, or a preset. Raises BadInput or BadInputs."""
    return load_file_or_preset(DriveModel, path, "file of a simulated drive", named_by)
