"""Physical quantities in files: absurd values are refused, unusual ones reported.

The outer bounds are beyond any machine, from a watch's stepper to a ship's propulsion: a value beyond them is
a slip, and would overflow the arithmetic of a simulation or a design. The usual ones are those of servo
drives, from a hundredth of a watt to a megawatt: a value outside is most often in another unit.
"""

from collections.abc import Iterator
from functools import cache
from typing import Annotated, Any, Final, NamedTuple, get_args

from pydantic import BaseModel, BeforeValidator, Field
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from servobench.hil.configuration.config_files import key_text


class Usual(NamedTuple):
    """Mark of a type: the range of usual values."""

    least: float
    most: float


def _whole(value: Any) -> Any:
    if isinstance(value, bool | float):  # they equal a number of a Literal
        raise PydanticCustomError("whole", "a whole number")
    return value


WHOLE: Final = BeforeValidator(_whole)
"""Mark of a Literal of whole numbers."""
Resistance = Annotated[float, Field(ge=1e-6, le=1e5), Usual(1e-3, 200.0)]
"""ohm"""
Inductance = Annotated[float, Field(ge=1e-9, le=10.0), Usual(1e-6, 0.5)]
"""H"""
FluxLinkage = Annotated[float, Field(ge=1e-7, le=100.0), Usual(1e-4, 5.0)]
"""Wb"""
Inertia = Annotated[float, Field(ge=1e-11, le=1e5), Usual(1e-7, 5.0)]
"""kg m^2"""
ViscousFriction = Annotated[float, Field(ge=0.0, le=1e3), Usual(0.0, 1.0)]
"""N m per rad/s"""
CoulombFriction = Annotated[float, Field(ge=0.0, le=1e5), Usual(0.0, 100.0)]
"""N m"""
Torque = Annotated[float, Field(ge=1e-6, le=1e7), Usual(1e-3, 2e4)]
"""N m, of a rating or a limit"""
Angle = Annotated[float, Field(ge=-1e6, le=1e6)]
"""rad, from where a run begins"""
SignedTorque = Annotated[float, Field(ge=-1e7, le=1e7)]
"""N m"""
Speed = Annotated[float, Field(ge=1e-3, le=1e6), Usual(1.0, 1e5)]
"""r/min, of a rating or a limit"""
SignedSpeed = Annotated[float, Field(ge=-1e6, le=1e6)]
"""r/min"""
Current = Annotated[float, Field(ge=1e-4, le=1e5), Usual(0.05, 3e3)]
"""A"""
Voltage = Annotated[float, Field(ge=0.1, le=1e5), Usual(5.0, 1500.0)]
"""V"""
Stiffness = Annotated[float, Field(ge=1e-6, le=1e9)]
"""N m/rad"""
SlewRate = Annotated[float, Field(ge=1e-6, le=1e9)]
"""N m/s, or r/min per s"""
Gain = Annotated[float, Field(ge=-1e9, le=1e9)]
"""Gain of a controller; in its own unit"""
PositiveGain = Annotated[float, Field(ge=0.0, le=1e9)]
TimeConstant = Annotated[float, Field(ge=1e-6, le=1e5)]
"""s"""
Coefficient = Annotated[float, Field(ge=-1e15, le=1e15)]
"""Coefficient of a matrix, a weight or a transfer function: its square is far from the end of the floats."""
Frequency = Annotated[float, Field(ge=1e-6, le=5e3), Usual(1e-3, 200.0)]
"""Hz, of a reference: half the rate of the shortest period"""
DropoutsInARow = Annotated[int, Field(ge=1, le=1_000_000), Usual(1, 1000)]
"""A safety limit: beyond a second at 1 kHz the drive turns unobserved for long."""
HeartbeatTimeout = Annotated[int, Field(ge=2, le=65_535), Usual(2, 2000)]
"""ms: how long one side continues without the other."""


def odd_values(section: BaseModel, place: str = "") -> Iterator[str]:
    """Yield a note on each value of ``section`` outside the usual range, by its key in the file."""
    for name, usual in _usual_ranges(type(section)):
        yield from _odd(getattr(section, name), usual, f"{place}.{name}" if place else name)


def _odd(value: Any, usual: Usual | None, place: str) -> Iterator[str]:
    if isinstance(value, BaseModel):
        yield from odd_values(value, place)
    elif isinstance(value, dict):
        for name, item in value.items():
            yield from _odd(item, usual, f"{place}.{key_text(str(name))}")
    elif isinstance(value, tuple):
        for index, item in enumerate(value):
            yield from _odd(item, usual, f"{place}[{index}]")
    elif usual is not None and value is not None and not usual.least <= value <= usual.most:
        yield f"{place}: {value:g} is odd, {usual.least:g} to {usual.most:g} is usual: is it in that unit?"


@cache
def _usual_ranges(section: type[BaseModel]) -> tuple[tuple[str, Usual | None], ...]:
    """Return the fields of a section with their usual ranges; runs of a campaign ask again and again."""
    return tuple((name, _usual(field)) for name, field in section.model_fields.items())


def _usual(field: FieldInfo) -> Usual | None:
    """Return the mark of a field's type, or of a part of it, as in ``Torque | None``."""
    marks = [*field.metadata, *(mark for part in get_args(field.annotation) for mark in get_args(part))]
    return next((mark for mark in marks if isinstance(mark, Usual)), None)
