"""Drive files: the results of commissioning one drive, for a bench to run it with.

``hil commission`` leaves one, ``drive.toml``; a bench file names it as ``drive.NAME.commissioned``.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.canopen.objects301 import FIRST_OBJECT
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.hil.configuration.config_files import Section, load_file
from servobench.hil.configuration.quantities import WHOLE
from servobench.hil.write_lists import RUN

Sign = Annotated[Literal[-1, 1], WHOLE]


class DriveMarks(Section):
    """``[drive]``: the identity of the drive."""

    node: int = Field(ge=1, le=127)
    name: str = ""
    vendor: int = Field(ge=0, lt=1 << 32)
    product: int = Field(ge=0, lt=1 << 32)
    revision: int = Field(default=0, ge=0, lt=1 << 32)
    serial: int = Field(default=0, ge=0, lt=1 << 32)


class Scale(Section):
    """``[scale]``: corrections of factors in the drive's objects; absent: believe the drive."""

    position_rad: float | None = Field(default=None, gt=0, le=1e6)
    """rad of the motor shaft per position unit."""
    velocity_rad_s: float | None = Field(default=None, gt=0, le=1e6)
    acceleration_rad_s2: float | None = Field(default=None, gt=0, le=1e9)
    rated_torque_nm: float | None = Field(default=None, gt=0, le=1e6)


class Signs(Section):
    """``[signs]``: reversals that no object of the drive can make."""

    torque: Sign = 1
    """-1: positive torque turns the position down."""
    velocity: Sign = 1
    """-1: the velocity counts against the position."""


class SetObject(Section):
    """``[[object]]``: a setting that the run depends on, written before the drive is set up."""

    index: int = Field(ge=FIRST_OBJECT, le=0xFFFF)
    sub: int = Field(default=0, ge=0, le=255)
    bytes: str = Field(pattern=r"^([0-9a-f]{2}){1,8}$", description="octets in hexadecimal, as on the wire")

    @model_validator(mode="after")
    def _check_listed(self) -> Self:
        if (self.index, self.sub) not in RUN:
            raise ValueError("index: an object on the list of hil run (hil docs writes), or none")
        return self


class StopOfDrive(Section):
    """``[stop]``: how the drive stops if its quick stop ramp cannot be used."""

    option: Annotated[Literal[1, 2, 3], WHOLE] = 2
    """605Ah and 605Eh: the slow down ramp, the quick stop ramp, or the current limit."""


class LoopOfDrive(Section):
    """``current_loop``: torque demand to torque, measured by commissioning or assumed by a PID's rule."""

    order: int = Field(default=1, ge=1)
    """The measured loop is the first-order lag that finally is as far behind a step."""
    bandwidth_hz: float = Field(gt=0, description="where its open loop has gain 1, Hz")
    """A measured one includes every delay of the drive: waiting for its next sample, computing, the loop."""


class DriveFile(Section):
    """A complete drive file. Limits and controller are suggestions, for a bench file to copy."""

    drive: DriveMarks = Field(description="the table [drive]")
    scale: Scale = Scale()
    signs: Signs = Signs()
    object: Annotated[tuple[SetObject, ...], Field(strict=False)] = ()
    stop: StopOfDrive = StopOfDrive()
    current_loop: LoopOfDrive | None = None
    """Absent: the drive has no torque mode in which to measure it."""
    limits: dict[str, Any] = Field(default_factory=dict)
    controller: dict[str, Any] = Field(default_factory=dict)

    @property
    def override(self) -> ScaleOverride:
        """``scale`` and ``signs`` in the form for the drive client."""
        return ScaleOverride(
            **self.scale.model_dump(),
            velocity_sign=float(self.signs.velocity),
            torque_sign=float(self.signs.torque),
        )


def load_drive_file(path: Path, named_by: NamedBy | None = None) -> DriveFile:
    """Load the drive file at ``path``. Raises BadInput or BadInputs."""
    return load_file(DriveFile, path, "drive file", named_by)
