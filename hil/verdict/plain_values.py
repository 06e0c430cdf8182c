"""Makes dataclasses from plain values: between processes, and from files."""

from typing import Any, TypeVar

T = TypeVar("T")


def from_plain(kind: type[T], plain: Any) -> T:
    """Make a ``kind`` from the result of ``asdict`` and JSON. Raises ValueError for anything else."""
    from pydantic import TypeAdapter  # hil --help does without

    return TypeAdapter(kind).validate_python(plain)
