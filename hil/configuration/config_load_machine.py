"""``[load_machine]`` of a bench file: the instrument that puts the load on a shaft and measures it."""

from typing import Literal

from pydantic import Field

from drivers.instruments.dynamometer import BAUD, DynamometerSettings
from drivers.instruments.magtrol import Dialect, dialect
from drivers.timebase import NS_PER_MS, Duration
from hil.configuration.config_files import Section
from hil.configuration.quantities import Torque

SIMULATED = "simulated"


class LoadMachineConfig(Section):
    """``[load_machine]``: a serial dynamometer controller."""

    kind: Literal["magtrol_dsp7000", "magtrol_dsp6001"] = Field(
        description="'magtrol_dsp7000' or 'magtrol_dsp6001'; a DSP7000 in its 6001 mode is the latter"
    )
    port: str = Field(
        min_length=1, description="its serial port, or 'simulated' for one on the simulated drive's shaft"
    )
    torque_max_nm: Torque = Field(description="the largest torque that its brake may be asked for, N m")
    axis: str | None = None
    """On whose shaft it is; the only axis if absent."""
    baud: int = Field(default=BAUD, ge=300, le=921_600)
    channel: Literal[1, 2] = 1
    """Of a DSP7000 with two."""
    torque_unit: Literal["N.m", "N.cm", "N.mm", "kg.cm", "g.cm", "oz.in", "oz.ft", "lb.in", "lb.ft"] = "N.m"
    """What its display is set to."""
    clockwise_is_positive: bool = True
    """Whether positive speed of the drive is R on its display."""
    answer_timeout_ms: int = Field(default=1000, ge=10, le=10_000)
    """The manuals ask for at least a second; three in a row end the run."""
    reading_every_ms: int = Field(default=20, ge=1, le=10_000)

    @property
    def dialect(self) -> Dialect:
        """How to speak to it."""
        return dialect(self.kind, self.channel, self.torque_unit, self.clockwise_is_positive)

    @property
    def settings(self) -> DynamometerSettings:
        """How its driver is to deal with it."""
        return DynamometerSettings(
            self.baud,
            Duration(self.answer_timeout_ms * NS_PER_MS),
            Duration(self.reading_every_ms * NS_PER_MS),
        )
