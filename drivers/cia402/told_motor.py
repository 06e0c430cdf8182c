"""Motor data entered into a drive, read from its maker's objects (drivers/vendors)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.errors import TransferAborted
from servobench.drivers.vendors.families import motor_objects_for
from servobench.drivers.vendors.motor_objects import QUANTITIES, MotorObject, MotorObjects, NotTold

_PHRASES: Final = {
    "phase": "of a phase",
    "lines": "between lines",
    "rms": "rms",
    "peak": "peak",
    "own": "in the drive's own ampere",
}


@dataclass(frozen=True, slots=True)
class ToldFigure:
    """One quantity of the motor."""

    quantity: str
    """Key of :data:`servobench.drivers.vendors.motor_objects.QUANTITIES`."""
    value: float
    """SI, per phase of the star; A rms, or the drive's own ampere."""
    raw: int
    object: str
    """``2701h:01``."""
    family: str
    """The file in drivers/vendors that describes it."""
    convention: str
    """Convention of the raw value."""

    def __str__(self) -> str:
        """Name the object and its source."""
        by = f" {_PHRASES[self.convention]}" if self.convention else ""
        return f"told by the drive: object {self.object} = {self.raw}{by} ({self.family})"


@dataclass(frozen=True, slots=True)
class ToldMotor:
    """Motor data that could be read, and those that could not."""

    figures: Mapping[str, ToldFigure] = field(default_factory=dict)
    """Figures by quantity."""
    not_told: tuple[str, ...] = ()
    """Known objects of the maker that held no usable value, each with the reason."""

    def value(self, quantity: str) -> float | None:
        """Return a quantity in SI units; None if unknown."""
        figure = self.figures.get(quantity)
        return None if figure is None else figure.value


def read_told_motor(objects: RemoteObjects, vendor: int, product: int, device_name: str) -> ToldMotor:
    """Read the maker's motor objects, if any are known. Raises NoAnswer if the drive is silent."""
    figures: dict[str, ToldFigure] = {}
    not_told: list[str] = []
    for family, motor in motor_objects_for(vendor, product, device_name):
        taken, refused = _read_family(objects, family, motor)
        figures |= taken
        not_told += refused
    return ToldMotor(figures, tuple(not_told))


def _read_family(
    objects: RemoteObjects, family: str, motor: MotorObjects
) -> tuple[dict[str, ToldFigure], list[str]]:
    figures: dict[str, ToldFigure] = {}
    not_told: list[str] = []
    for each in motor.objects:
        name = object_name(each.index, each.sub)
        text = f"{QUANTITIES[each.quantity].title}: object {name}"
        try:
            data = objects.network.upload(objects.node_id, each.index, each.sub)
        except TransferAborted as error:
            if motor.whole:
                return {}, [f"motor data of {family}: the drive has no {name}, so none of them"]
            not_told.append(f"{text} ({family}) refused, {error.evidence}")
            continue
        try:
            figures[each.quantity] = _figure(each, data, name, family)
        except NotTold as error:
            not_told.append(f"{text} ({family}) tells {error}")
    return figures, not_told


def _figure(each: MotorObject, data: bytes, name: str, family: str) -> ToldFigure:
    value, raw = each.value(data)
    return ToldFigure(each.quantity, value, raw, name, family, each.convention)
