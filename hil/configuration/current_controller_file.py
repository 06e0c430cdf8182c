"""Files of a current controller: written by ``hil design current --out``, run by a simulated drive."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from servobench.design.statespace import StateSpace, from_zpk
from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_files import Section, load_file
from servobench.hil.configuration.quantities import Coefficient

ORDER_MAX = 64
"""Roots; a drive runs three or four of them 16 000 times a second."""
Root = Annotated[tuple[Coefficient, Coefficient], Field(strict=False)]
Roots = Annotated[tuple[Root, ...], Field(strict=False, max_length=ORDER_MAX)]


class ContinuousController(Section):
    """gain * prod(s - zeros)/prod(s - poles), volts per ampere; sampled by Tustin's rule where it runs."""

    kind: Literal["continuous"]
    axis: Literal["d", "q"] = Field(description="'d' or 'q'")
    gain: Coefficient = Field(description="the gain of the zero-pole form")
    zeros_rad_s: Roots = Field(description="[real, imaginary] of each zero, rad/s")
    poles_rad_s: Roots = Field(description="[real, imaginary] of each pole, rad/s")
    prewarp_rad_s: Coefficient = Field(default=0.0, ge=0)
    """Frequency at which Tustin's rule is exact: the loop's crossover."""

    def at_rate(self, rate_hz: int) -> StateSpace:
        """Return the sampled controller. Error: ValueError for roots without their conjugate or too low a
        rate."""
        from servobench.design.hinf.bilinear import tustin  # with scipy: a third of a second, for who has one

        return tustin(self.continuous(), rate_hz, self.prewarp_rad_s)

    def continuous(self) -> StateSpace:
        """Return the controller itself. Error: ValueError for roots without their conjugate."""
        return from_zpk(_numbers(self.zeros_rad_s), _numbers(self.poles_rad_s), self.gain)


class SampledController(Section):
    """gain * prod(z - zeros)/prod(z - poles), made for one inner rate only."""

    kind: Literal["sampled"]
    axis: Literal["d", "q"] = Field(description="'d' or 'q'")
    gain: Coefficient = Field(description="the gain of the zero-pole form")
    zeros_z: Roots = Field(description="[real, imaginary] of each zero in the z plane")
    poles_z: Roots = Field(description="[real, imaginary] of each pole in the z plane")
    sample_rate_hz: int = Field(gt=0, description="the inner rate that it was made for, Hz")

    def at_rate(self, rate_hz: int) -> StateSpace:
        """Return the controller. Error: ValueError for another rate than its own."""
        if rate_hz != self.sample_rate_hz:
            raise ValueError(f"made for {self.sample_rate_hz} Hz, the drive's inner rate is {rate_hz} Hz")
        return from_zpk(_numbers(self.zeros_z), _numbers(self.poles_z), self.gain, 1.0 / rate_hz)

    def continuous(self) -> StateSpace:
        """Return the continuous system that Tustin's rule maps to this controller."""
        from servobench.design.hinf.bilinear import to_bilinear

        return to_bilinear(self.at_rate(self.sample_rate_hz))


def _numbers(roots: tuple[tuple[float, float], ...]) -> list[complex]:
    return [complex(*root) for root in roots]


CurrentController = Annotated[ContinuousController | SampledController, Field(discriminator="kind")]


class CurrentControllerFile(Section):
    """A whole file."""

    current_controller: CurrentController = Field(
        description="the table [current_controller] with kind = 'continuous' or 'sampled'"
    )


class CurrentControl(Section):
    """``current_control``: controllers that the simulated drive runs instead of its PI current loops."""

    controller: CurrentController | None = None
    """Path of the controller on the q axis, which makes the torque; default: PI."""
    controller_d: CurrentController | None = None
    """Path of the controller on the d axis; default: PI."""


def load_current_controller(path: Path, named_by: NamedBy, axis: str) -> CurrentController:
    """Load the controller file at ``path``, made for ``axis``. Raises BadInput or BadInputs."""
    controller = read_current_controller(path, named_by)
    if controller.axis != axis:
        raise BadInput(
            named_by.source,
            named_by.key,
            f"a controller for the {controller.axis} axis",
            f"one for the {axis} axis",
        )
    return controller


def read_current_controller(path: Path, named_by: NamedBy) -> CurrentController:
    """Load the controller file at ``path``, for either axis. Raises BadInput or BadInputs."""
    file = load_file(CurrentControllerFile, path, "current controller file", named_by)
    controller = file.current_controller
    try:
        controller.at_rate(controller.sample_rate_hz if controller.kind == "sampled" else 1_000_000)
    except ValueError as error:
        raise BadInput(str(path), "current_controller", str(error), "a controller that can be run") from None
    return controller
