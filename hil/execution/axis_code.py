"""Makes the controllers and compensators of a run, before anything moves, with the files of user code."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.controller_kinds import ArrivalCompensator, OwnCode
from servobench.hil.control.own_code import source_of
from servobench.hil.control.setup import Setup
from servobench.hil.loop.axis_roles import Compensator, Controller
from servobench.hil.loop.quantity_by_mode import QUANTITY_BY_MODE

PATIENCE_SIMULATED_S = 10.0
"""Limit of a user code call in simulated time, s: more than a solver takes for a step. On a bus in real time
a drive stops by itself when it misses the host, which is the limit then."""


@dataclass(frozen=True, slots=True)
class AxisCode:
    """The code of one axis."""

    controller: Controller
    compensator: Compensator
    own: Mapping[str, "KeptSource"] = field(default_factory=dict)
    """User classes by their key in the bench file: controller, compensator."""


@dataclass(frozen=True, slots=True)
class KeptSource:
    """The file of a user class."""

    name: str
    """Name of the class, as in the bench file."""
    file: Path
    digest: str
    """BLAKE2b, 128 bit, hex."""


def check_axes(config: BenchConfig, controllers: Mapping[str, Controller]) -> None:
    """Raise BadInput for a controller of a missing axis: the bench's own would run instead."""
    for name in controllers:
        if name not in config.axes:
            expected = f"one of the bench's axes: {', '.join(config.axes)}"
            raise BadInput(config.source, "controllers", name, expected)


def axis_code(
    config: BenchConfig, given: Mapping[str, Controller], *, real_time: bool
) -> dict[str, AxisCode]:
    """Make the code of every axis; ``given``: by axis, a controller in place of the bench's.

    It runs user code, if the bench names any. Raises BadInput.
    """
    return {axis: _of_axis(config, axis, given.get(axis), real_time) for axis in config.axes}


def _of_axis(config: BenchConfig, axis: str, given: Controller | None, real_time: bool) -> AxisCode:
    drive = config.drive[axis]
    patience_s = config.host.heartbeat_timeout_ms / 1e3 if real_time else PATIENCE_SIMULATED_S
    setup = Setup(
        axis,
        config.loop.period,
        drive.motor.parameters,
        drive.limits.torque_max_nm,
        drive.limits.speed_max_rad_s,
        patience_s,
        config.source,
        QUANTITY_BY_MODE[drive.mode],
    )
    own = {}
    for key in ("compensator",) if given else ("controller", "compensator"):
        if isinstance(section := getattr(drive, key), OwnCode):
            own[key] = _source_of(section, config.source, f"drive.{axis}.{key}.object")
    controller = given or drive.controller.build(setup)
    observer = controller.observer()
    if observer is None:
        return AxisCode(controller, drive.compensator.build(setup), own)
    if not isinstance(drive.compensator, ArrivalCompensator):
        expected = "none, as the controller has its own"
        raise BadInput(config.source, f"drive.{axis}.compensator", drive.compensator.kind, expected)
    return AxisCode(controller, observer, own)


def _source_of(section: OwnCode, source: str, key: str) -> KeptSource:
    try:
        file, digest = source_of(section.object)
    except ValueError as error:
        expected = "MODULE:NAME of an installed module, or FILE.py:NAME of a file beside the bench file"
        raise BadInput(source, key, section.object, expected, str(error)) from error
    return KeptSource(section.object, file, digest)
