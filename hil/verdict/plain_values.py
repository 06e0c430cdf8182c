"""Dataclasses out of plain values: what a process hands to another, and what is in files."""

from typing import Any, TypeVar

T = TypeVar("T")


def from_plain(kind: type[T], plain: Any) -> T:
    """A ``kind`` out of what ``asdict`` and JSON made of one. Raises ValueError for anything else."""
    from pydantic import TypeAdapter  # hil --help does without

    return TypeAdapter(kind).validate_python(plain)
