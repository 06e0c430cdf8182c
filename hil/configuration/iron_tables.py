"""Tables of a motor file that no drive and no design knows of: ``[saturation]`` and ``[temperature]``."""

from typing import Annotated

from pydantic import Field

from servobench.design.data_sheet import at_temperature
from servobench.design.iron import Iron, iron_of
from servobench.design.motor import Heat, PmsmParameters
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.quantities import Current


class SaturationTable(Section):
    """``[saturation]``: iron whose inductances are those of ``[motor]`` up to a current only."""

    linear_to_a: Current | None = Field(
        default=None, description="q current up to which torque is proportional to it, dq A"
    )
    """Default: twice the current of the rated torque."""
    torque_percent: float = Field(
        ge=10.0, lt=100.0, description="torque at rating.current_max_a, of the proportional one"
    )

    def iron(self, motor: PmsmParameters) -> Iron:
        """The iron of that motor. Error: ValueError for what no iron does."""
        return iron_of(
            motor.inductance_d_h,
            motor.inductance_q_h,
            motor.flux_linkage_wb,
            linear_to_a=2.0 * motor.rated_current_a if self.linear_to_a is None else self.linear_to_a,
            at_a=motor.current_max_a,
            torque_share=self.torque_percent / 100.0,
        )


Celsius = Annotated[float, Field(ge=-60.0, le=250.0)]


class TemperatureTable(Section):
    """``[temperature]``: of the motor that turns; the drive and the bench reckon with the sheet's."""

    winding_c: Celsius = Field(description="of the winding, degrees C")
    magnet_c: Celsius = Field(description="of the magnets, degrees C")
    sheet_c: Celsius = Field(default=20.0, description="at which resistance and flux are those of [motor]")
    magnet_percent_k: float = Field(
        default=-0.12, ge=-1.0, le=0.0, description="what the flux changes by a kelvin, %"
    )

    @property
    def heat(self) -> Heat:
        return Heat(
            at_temperature(1.0, self.sheet_c, self.winding_c),
            1.0 + self.magnet_percent_k / 100.0 * (self.magnet_c - self.sheet_c),
        )
