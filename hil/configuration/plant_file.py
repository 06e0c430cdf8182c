"""Plant files: the standard problem of an H-infinity synthesis, as TOML or JSON."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from servobench.design.hinf.plant import GeneralisedPlant
from servobench.design.statespace import state_space
from servobench.drivers.bounded_file import NamedBy, parse_json, read_text, read_toml
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_files import Section, validated
from servobench.hil.configuration.quantities import Coefficient

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
