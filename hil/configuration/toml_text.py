"""Writes plain tables as TOML text, which the standard library reads but does not write.

tomlkit takes 40 ms to load: only a writer, or an error about a bad key, waits for it.
"""

from collections.abc import Mapping
from typing import Any


def toml_text(tables: Mapping[str, Any]) -> str:
    """Return ``tables`` as TOML v1.0: reading it back gives an equal mapping.

    Values: bool, int, float, str, and lists and tables of them. Raises TypeError for another type.
    """
    import tomlkit

    return tomlkit.dumps(tables)


def key_text(key: str) -> str:
    """Return one key, in quotes if it needs them."""
    import tomlkit

    return tomlkit.key(key).as_string()
