"""Digest of a controller's table, by which a file that was changed after its design is known."""

import hashlib
import json
from typing import Any

_KEY = "digest"
"""Key of the certificate that holds the digest, and is not covered by it."""


def digest_of(controller: dict[str, Any]) -> str:
    """Return SHA-256 over all keys and digits of a table that was read with ``parse_float=Decimal``."""
    return hashlib.sha256(json.dumps(_without(controller), sort_keys=True, default=str).encode()).hexdigest()


def _without(table: Any) -> Any:
    if isinstance(table, dict):
        return {key: _without(value) for key, value in table.items() if key != _KEY}
    return table
