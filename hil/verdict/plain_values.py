"""Makes dataclasses from plain values: between processes, and from files."""

from functools import cache
from typing import Any, TypeVar

T = TypeVar("T")


def from_plain(kind: type[T], plain: Any) -> T:
    """Make a ``kind`` from the result of ``asdict`` and JSON. Raises ValueError for anything else."""
    key: Any = kind  # mypy has no dataclass for hashable
    made: T = _adapter(key).validate_python(plain)
    return made


@cache
def _adapter(kind: type) -> Any:
    """It takes milliseconds to make; a campaign's worker and a list of runs need hundreds of one kind."""
    from pydantic import TypeAdapter  # hil --help does without

    return TypeAdapter(kind)
