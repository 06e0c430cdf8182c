"""Common parts of every configuration file: reading its tables, and the rules for them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from servobench.drivers.bounded_file import NamedBy, read_toml
from servobench.hil.configuration.config_errors import raise_all, translate


class Section(BaseModel):
    """A table of a file of the bench: immutable, without unknown keys, silent conversion or nan."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True
    )


F = TypeVar("F", bound=Section)


def load_file(model: type[F], path: Path, kind: str, named_by: NamedBy | None) -> F:
    """Load the file at ``path``; ``kind``: its kind, ``named_by``: its source. Raises BadInput or
    BadInputs."""
    return validated(model, read_toml(path, kind, named_by), str(path))


def validated(model: type[F], tables: Mapping[str, Any], source: str) -> F:
    """Validate the ``tables`` of the file ``source``. Raises BadInput or BadInputs."""
    try:
        return model.model_validate(tables)
    except ValidationError as error:
        raise_all(translate(error, source, tables, model))
