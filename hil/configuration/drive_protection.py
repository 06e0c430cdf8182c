"""``[protection]`` of the file of a simulated drive: what of power stage, motor and encoder it watches."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.motor_tables import Celsius
from servobench.hil.configuration.quantities import Current, Voltage
from servobench.virtual_bus.drive.power_stage import Overload, Protection, StageHeat

Percent = Annotated[float, Field(ge=1.0, le=100.0)]


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


class StageTable(Section):
    """``[protection.stage]``: temperature of the power stage, which its current heats."""

    ambient_c: Celsius = Field(default=25.0, description="around it, degrees C")
    rise_k: float = Field(gt=0.0, le=500.0, description="above that for ever at at_a_rms, K")
    at_a_rms: Current = Field(description="A rms of a phase; the rise goes by its square")
    time_constant_s: float = Field(ge=0.01, le=10_000.0, description="of stage and heat sink, s")
    max_c: Celsius = Field(description="above which it fails: fault 4210h")
    clear_c: Celsius | None = Field(default=None, description="below which it is well again; absent: max_c")
    derate_from_c: Celsius | None = Field(
        default=None, description="from which the largest current falls, to 0 at max_c; absent: it does not"
    )

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        for name in ("ambient_c", "clear_c", "derate_from_c"):
            value = getattr(self, name)
            if value is not None and value > self.max_c - (0.0 if name == "clear_c" else 1.0):
                raise ValueError(f"{name} below max_c = {self.max_c:g}")
        return self

    @property
    def parameters(self) -> StageHeat:
        """The power stage of the simulated drive."""
        clear_c = self.max_c if self.clear_c is None else self.clear_c
        return StageHeat(
            self.ambient_c,
            self.rise_k,
            self.at_a_rms,
            self.time_constant_s,
            self.max_c,
            clear_c,
            self.derate_from_c,
        )


class ProtectionTable(Section):
    """``[protection]``: limits at which the power stage opens by itself; absent: not watched."""

    over_voltage_v: Voltage | None = None
    """Greatest voltage of the DC link: fault 3210h."""
    under_voltage_v: Voltage | None = None
    """Least voltage of the DC link while the drive is enabled: fault 3220h."""
    over_current_a_rms: Current | None = None
    """Amplitude of the current as A rms: fault 2310h."""
    overload: OverloadTable | None = None
    """The table [protection.overload]; fault 2350h."""
    winding_max_c: float | None = Field(default=None, ge=20.0, le=250.0)
    """Greatest temperature that the motor's sensor may tell: fault 4310h."""
    missing_counts_max: int | None = Field(default=None, ge=1, le=2**30)
    """Encoder counts that may be missing between two index pulses: fault 7305h."""
    stage: StageTable | None = None
    """The table [protection.stage]; fault 4210h."""

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
            self.winding_max_c,
            self.missing_counts_max,
            None if self.stage is None else self.stage.parameters,
        )
