"""Files of simulated drives: their source, ``[supply]``, and limits of their power stage, ``[protection]``.

``like`` of ``[drive.NAME.simulation]`` names one, or has its tables.
"""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from servobench.drivers.bounded_file import NamedBy
from servobench.hil.configuration.config_files import Section, load_file
from servobench.hil.configuration.quantities import Current, Resistance, Voltage
from servobench.virtual_bus.drive.power_stage import Chopper, Overload, Protection, Supply

_TIME_CONSTANT_MIN_S = 1e-5
"""Of resistance and capacitance: a period of 62.5 us is then cut into 63 steps."""
_UF = 1e-6
Percent = Annotated[float, Field(ge=1.0, le=100.0)]


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


class OverloadTable(Section):
    """``[protection.overload]``: I^2 t above the continuous current."""

    continuous_a_rms: Current = Field(description="current of a phase that can flow for ever, A rms")
    peak_a_rms: Current = Field(description="current that can flow for peak_time_s, A rms")
    peak_time_s: float = Field(ge=0.01, le=600.0, description="from a cold start, s")
    warning_percent: Percent = 80.0
    """Share of the sum at which statusword bit 7 warns."""
    clear_percent: Percent = 80.0
    """Share of the sum below which a limited current is free again."""
    reaction: Literal["limit", "fault"] = "limit"
    """To limit the current to the continuous one, or a fault with the reaction of 605Eh."""

    @model_validator(mode="after")
    def _check_peak(self) -> Self:
        if self.peak_a_rms <= self.continuous_a_rms:
            raise ValueError(f"peak_a_rms above continuous_a_rms = {self.continuous_a_rms:g}")
        return self

    @property
    def parameters(self) -> Overload:
        """The overload of the simulated drive."""
        return Overload(
            self.continuous_a_rms,
            self.peak_a_rms,
            self.peak_time_s,
            self.warning_percent,
            self.clear_percent,
            self.reaction == "fault",
        )


class ProtectionTable(Section):
    """``[protection]``: limits at which the power stage opens by itself; absent: not watched."""

    over_voltage_v: Voltage | None = None
    """Of the DC link: fault 3210h."""
    under_voltage_v: Voltage | None = None
    """Of the DC link while the drive is enabled: fault 3220h."""
    over_current_a_rms: Current | None = None
    """Amplitude of the current as A rms: fault 2310h."""
    overload: OverloadTable | None = None
    """The table [protection.overload]; fault 2350h."""

    @model_validator(mode="after")
    def _check_band(self) -> Self:
        low, high = self.under_voltage_v, self.over_voltage_v
        if low is not None and high is not None and low >= high:
            raise ValueError(f"under_voltage_v below over_voltage_v = {high:g}")
        return self

    @property
    def parameters(self) -> Protection:
        """The protection of the simulated drive."""
        return Protection(
            self.over_voltage_v,
            self.under_voltage_v,
            self.over_current_a_rms,
            None if self.overload is None else self.overload.parameters,
        )


class DriveModel(Section):
    """A whole file of a simulated drive."""

    supply: SupplyTable | None = Field(default=None, description="the table [supply]")
    protection: ProtectionTable | None = Field(default=None, description="the table [protection]")


def load_drive_model(path: Path, named_by: NamedBy | None = None) -> DriveModel:
    """Load the file of a simulated drive at ``path``. Raises BadInput or BadInputs."""
    return load_file(DriveModel, path, "file of a simulated drive", named_by)
