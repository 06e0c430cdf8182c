"""Files that a design starts from: the bounds on |S|, |KS| and |T| of a current controller (TOML), and the
standard problem of an H-infinity synthesis (TOML or JSON).
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from servobench.design.hinf.mixed_sensitivity import (
    GeneralisedPlant,
    Weight,
    Weights,
    crossing_weight,
    error_weight,
    slope_weight,
)
from servobench.design.statespace import state_space
from servobench.drivers.bounded_file import NamedBy, parse_json, read_text, read_toml
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_files import Section, load_file, validated
from servobench.hil.configuration.quantities import Coefficient


class WeightRefused(BadInput):
    """A weight that breaks an assumption of the synthesis: its own words name it, and the cure."""

    def __init__(self, source: str, key: str, reason: str) -> None:
        super().__init__(source, key, reason, "a weight that keeps A1 to A4")

    def __str__(self) -> str:
        return f"{self.source}: {self.key}: {self.value}"


class ZeroPole(Section):
    """high (s + zero)/(s + pole)."""

    kind: Literal["zero_pole"]
    high: Coefficient = Field(description="gain at high frequency")
    zero_rad_s: Coefficient = Field(description="the zero's rate, rad/s")
    pole_rad_s: Coefficient = Field(description="the pole's rate, rad/s")

    def weight(self) -> Weight:
        """Return the weight."""
        return Weight(self.high, self.zero_rad_s, self.pole_rad_s)


class ByCrossing(Section):
    """Both gains, and where |w| = 1."""

    kind: Literal["crossing"]
    low: Coefficient = Field(gt=0, description="gain at rest")
    high: Coefficient = Field(description="gain at high frequency")
    crossing_rad_s: Coefficient = Field(gt=0, description="where the weight is 1, rad/s")

    def weight(self) -> Weight:
        """Return the weight. Error: ValueError unless 1 lies between the gains."""
        return crossing_weight(self.low, self.high, self.crossing_rad_s)


class BySlope(Section):
    """Both gains, and the zero: the end of the slope of a falling weight, the start of a rising one's."""

    kind: Literal["slope"]
    low: Coefficient = Field(gt=0, description="gain at rest")
    high: Coefficient = Field(description="gain at high frequency")
    slope_end_rad_s: Coefficient = Field(gt=0, description="the zero's rate, rad/s")

    def weight(self) -> Weight:
        """Return the weight."""
        return slope_weight(self.low, self.high, self.slope_end_rad_s)


class ByError(Section):
    """[Azaiz2007] 3.2 for w1: 1/|w1| crosses 1 there, ends at ``peak``, starts at ``static_error``."""

    kind: Literal["error"]
    crossing_rad_s: Coefficient = Field(gt=0, description="where 1/|w1| is 1, rad/s")
    peak: Coefficient = Field(gt=1, description="1/|w1| at high frequency, above 1")
    static_error: Coefficient = Field(lt=1, description="1/|w1| at rest, below 1")

    def weight(self) -> Weight:
        """Return the weight."""
        return error_weight(self.crossing_rad_s, self.peak, self.static_error)


class Constant(Section):
    """The same gain at every frequency."""

    kind: Literal["constant"]
    gain: Coefficient = Field(description="the gain")

    def weight(self) -> Weight:
        """Return the weight; its pole and zero, at 1 rad/s, cancel."""
        return Weight(self.gain, 1.0, 1.0)


AnyWeight = Annotated[ZeroPole | ByCrossing | BySlope | ByError | Constant, Field(discriminator="kind")]


class WeightsFile(Section):
    """A whole file."""

    error: AnyWeight = Field(description="the table [error], w1, with kind, e.g. 'error'")
    control: AnyWeight = Field(description="the table [control], w2, with kind, e.g. 'zero_pole'")
    output: AnyWeight = Field(description="the table [output], w3, with kind, e.g. 'slope'")


def load_weights(path: Path) -> Weights:
    """Load the weights in the file at ``path``. Raises BadInput or BadInputs."""
    file = load_file(WeightsFile, path, "weights file", NamedBy("--weights", "", str(path)))
    weights = []
    for name in ("error", "control", "output"):
        try:
            weights.append(getattr(file, name).weight())
        except ValueError as error:
            raise WeightRefused(str(path), name, str(error)) from None
    return Weights(*weights)


ORDER_MAX = 100
"""Rows or columns; the cost of a synthesis grows with their cube, and plants of the field have ten."""
Number = Annotated[Coefficient, Field(strict=False)]
Row = Annotated[tuple[Number, ...], Field(strict=False, max_length=ORDER_MAX)]
Matrix = Annotated[tuple[Row, ...], Field(strict=False, max_length=ORDER_MAX)]


class PlantFile(Section):
    """x' = A x + B [w; u], [z; y] = C x + D [w; u]."""

    A: Matrix = Field(description="n rows of n numbers")
    B: Matrix = Field(description="n rows, the columns of w, then those of u")
    C: Matrix = Field(description="the rows of z, then those of y, of n numbers")
    D: Matrix = Field(description="the rows of z, then y; the columns of w, then u")
    controls: int = Field(ge=1, description="how many of the inputs are controls u, the last ones")
    measurements: int = Field(ge=1, description="how many of the outputs are measurements y, the last ones")


def load_plant(path: Path) -> GeneralisedPlant:
    """Load the plant in the file at ``path``. Raises BadInput or BadInputs."""
    tables = _tables(path, NamedBy("PLANT.toml", "", str(path)))
    file = validated(PlantFile, tables, str(path))
    for name in "ABCD":
        if len({len(row) for row in getattr(file, name)}) > 1:
            raise BadInput(str(path), name, "rows of different lengths", "rows of one length")
    try:
        system = state_space(file.A, file.B, file.C, file.D)
        return GeneralisedPlant(system, file.controls, file.measurements)
    except ValueError as error:
        raise BadInput(
            str(path), "", str(error), "matrices that fit: A (n, n), B (n, m), C (p, n), D (p, m)"
        ) from None


def _tables(path: Path, named_by: NamedBy) -> dict[str, Any]:
    if path.suffix != ".json":
        return read_toml(path, "plant file", named_by)
    tables = parse_json(read_text(path, "plant file", named_by), str(path), "a JSON object with A, B, C, D")
    if not isinstance(tables, dict):
        raise BadInput(str(path), "", type(tables).__name__, "a JSON object with A, B, C, D")
    return tables
