"""Tables of a motor file: ``[load]``, ``[switches]``, ``[saturation]``, ``[temperature]``, ``[commutation]``.

Of the load: torque by place and speed, and end stops.
"""

import math
from itertools import pairwise
from typing import Annotated, Self

from pydantic import Field, model_validator

from servobench.design.data_sheet import at_temperature
from servobench.design.iron import Iron, iron_of
from servobench.design.mechanism import Arm, EndStops, LoadMap, PlacedLoad, Switches
from servobench.design.motor import Commutation, Heat, PmsmParameters
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.vendors.motor_objects import POLE_PAIRS_MAX
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.quantities import Angle, Current, SignedSpeed, SignedTorque, Stiffness

_POINTS_MAX = 1000
_Row = Annotated[tuple[SignedTorque, ...], Field(strict=False, min_length=1, max_length=_POINTS_MAX)]


class CommutationTable(Section):
    """``[commutation]``: how encoder and lines are joined; a simulated drive that has it has to be told."""

    offset_deg: float = Field(
        default=0.0, ge=-360.0, le=360.0, description="to be added to the encoder's electrical angle, degrees"
    )
    lines_swapped: bool = False
    """Two of the motor's lines are swapped."""
    pole_pairs_set: int | None = Field(
        default=None, gt=0, le=POLE_PAIRS_MAX, description="what the drive is delivered with; absent: right"
    )

    @property
    def commutation(self) -> Commutation:
        return Commutation(math.radians(self.offset_deg), self.lines_swapped, self.pole_pairs_set)


class ArmTable(Section):
    """``[load.arm]``: a weight on an arm."""

    torque_nm: float = Field(gt=0.0, le=1e5, description="at the motor, of an arm that lies level, N m")
    ratio: float = Field(default=1.0, ge=1e-3, le=1e5, description="turns of the motor for one of the arm")
    phase_deg: float = Field(
        default=0.0, ge=-360.0, le=360.0, description="of the arm at power-on, degrees; 0 hangs down"
    )

    @property
    def arm(self) -> Arm:
        return Arm(self.torque_nm, self.ratio, math.radians(self.phase_deg))


class LoadMapTable(Section):
    """``[load.table]``: torque over place and speed, straight between points, held beyond the last ones."""

    position_rad: Annotated[tuple[Angle, ...], Field(strict=False, min_length=1, max_length=_POINTS_MAX)] = (
        0.0,
    )
    """Angles of the motor since power-on, rising; default: the same everywhere."""
    speed_rpm: Annotated[
        tuple[SignedSpeed, ...], Field(strict=False, min_length=1, max_length=_POINTS_MAX)
    ] = (0.0,)
    """Speeds of the load, rising; default: the same at every speed."""
    torque_nm: Annotated[tuple[_Row, ...], Field(strict=False, min_length=1, max_length=_POINTS_MAX)]
    """A row for each position with a torque for each speed, N m; positive opposes positive speed."""
    repeats: bool = False
    """The last position is the first again: a crank, a cam."""

    @model_validator(mode="after")
    def _check_grid(self) -> Self:
        for name in ("position_rad", "speed_rpm"):
            points = getattr(self, name)
            if any(after <= before for before, after in pairwise(points)):
                raise ValueError(f"{name} rising")
        rows, columns = len(self.position_rad), len(self.speed_rpm)
        if len(self.torque_nm) != rows or any(len(row) != columns for row in self.torque_nm):
            raise ValueError(f"torque_nm of {rows} rows of {columns}, a row for each position")
        if self.repeats and (rows < 2 or self.torque_nm[0] != self.torque_nm[-1]):
            raise ValueError(
                "with repeats two positions at least, and the last row of torque_nm as the first"
            )
        return self

    @property
    def table(self) -> LoadMap:
        return LoadMap(
            tuple(place / math.tau for place in self.position_rad),
            tuple(speed * RAD_S_PER_RPM for speed in self.speed_rpm),
            self.torque_nm,
            self.repeats,
        )


class EndStopsTable(Section):
    """``[load.end_stops]``: springs with dampers at the ends of the way."""

    negative_rad: Angle | None = None
    """Where the load touches it, of the motor since power-on; absent: no stop at that end."""
    positive_rad: Angle | None = None
    stiffness_nm_rad: Stiffness = Field(description="of one stop, N m/rad")
    damping_ratio: float = Field(default=0.1, ge=0.0, le=1.0, description="of the load on the stop")

    @model_validator(mode="after")
    def _check_way(self) -> Self:
        low, high = self.negative_rad, self.positive_rad
        if low is None and high is None:
            raise ValueError("negative_rad, positive_rad or both")
        if low is not None and high is not None and low >= high:
            raise ValueError(f"negative_rad below positive_rad = {high:g}")
        return self

    @property
    def stops(self) -> EndStops:
        low, high = (
            None if end is None else end / math.tau for end in (self.negative_rad, self.positive_rad)
        )
        return EndStops(low, high, self.stiffness_nm_rad, self.damping_ratio)


class LoadTables(Section):
    """``[load]``: it acts behind the coupling, where there is one."""

    hanging_nm: SignedTorque = 0.0
    """Torque of a weight on a rope, at the motor: against positive speed at every place."""
    arm: ArmTable | None = Field(default=None, description="the table [load.arm]")
    table: LoadMapTable | None = Field(default=None, description="the table [load.table]")
    end_stops: EndStopsTable | None = Field(default=None, description="the table [load.end_stops]")

    @property
    def load(self) -> PlacedLoad:
        return PlacedLoad(
            self.hanging_nm,
            None if self.arm is None else self.arm.arm,
            None if self.table is None else self.table.table,
            None if self.end_stops is None else self.end_stops.stops,
        )


class SwitchesTable(Section):
    """``[switches]``: limit and home switches beside the axis, bits 0 to 2 of 60FDh."""

    negative_rad: Angle | None = None
    """Angle of the motor since power-on: active here and below; absent: not fitted, as are the next three."""
    positive_rad: Angle | None = None
    """Active here and above."""
    home_from_rad: Angle | None = None
    home_to_rad: Angle | None = None
    bounce_us: float = Field(default=0.0, ge=0.0, le=50_000.0)
    """From the crossing of an edge until the contact rests."""
    bounces: int = Field(default=3, ge=1, le=8)
    """In that time; the contact changes twice in each, at instants drawn from the bench's seed."""
    filter_us: float = Field(default=0.0, ge=0.0, le=50_000.0)
    """Filter of the drive's inputs: a change that lasts shorter is not seen."""
    swapped: bool = False
    """Each limit switch is wired to the input of the other, as by a mistake."""

    @model_validator(mode="after")
    def _check_places(self) -> Self:
        if (self.home_from_rad is None) != (self.home_to_rad is None):
            raise ValueError("home_from_rad and home_to_rad, or neither")
        if self.home_from_rad is not None and self.home_to_rad is not None:
            if self.home_from_rad > self.home_to_rad:
                raise ValueError(f"home_from_rad up to home_to_rad = {self.home_to_rad:g}")
        elif self.negative_rad is None and self.positive_rad is None:
            raise ValueError(
                "a place of a switch: negative_rad, positive_rad, or home_from_rad and home_to_rad"
            )
        return self

    @property
    def switches(self) -> Switches:
        def turns(place_rad: float | None) -> float | None:
            return None if place_rad is None else place_rad / math.tau

        home_from, home_to = turns(self.home_from_rad), turns(self.home_to_rad)
        return Switches(
            turns(self.negative_rad),
            turns(self.positive_rad),
            None if home_from is None or home_to is None else (home_from, home_to),
            self.bounce_us * 1e-6,
            self.bounces,
            self.filter_us * 1e-6,
            self.swapped,
        )


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
    bearing_c: Celsius | None = Field(default=None, description="of bearings and gear; absent: sheet_c")
    viscous_percent_k: float = Field(
        default=-1.0, ge=-4.0, le=0.0, description="what viscous friction changes by a kelvin, %"
    )

    @model_validator(mode="after")
    def _rubs_still(self) -> Self:
        if self._viscous_factor < 0.0:
            raise ValueError("viscous_percent_k that leaves viscous friction at bearing_c")
        return self

    @property
    def _viscous_factor(self) -> float:
        warmer_k = 0.0 if self.bearing_c is None else self.bearing_c - self.sheet_c
        return 1.0 + self.viscous_percent_k / 100.0 * warmer_k

    @property
    def heat(self) -> Heat:
        return Heat(
            at_temperature(1.0, self.sheet_c, self.winding_c),
            1.0 + self.magnet_percent_k / 100.0 * (self.magnet_c - self.sheet_c),
            self.winding_c,
            self._viscous_factor,
        )
