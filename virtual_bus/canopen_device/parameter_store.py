"""Where a device keeps its stored parameters over a power cycle."""

import json
import os
from pathlib import Path
from typing import Protocol

from drivers.errors import BadInput

Parameters = dict[tuple[int, int], bytes]
"""Raw bytes, as over SDO, by index and sub-index."""


class ParameterStore(Protocol):
    """Non-volatile memory."""

    def load(self) -> Parameters:
        """What was saved last; empty if nothing was."""
        ...

    def save(self, parameters: Parameters) -> None:
        """Replace the contents. Error: OSError, and then the old contents stay."""
        ...


class MemoryStore:
    """Lives as long as the process."""

    def __init__(self) -> None:
        self._parameters: Parameters = {}

    def load(self) -> Parameters:
        """A copy of what was saved."""
        return dict(self._parameters)

    def save(self, parameters: Parameters) -> None:
        """Keep a copy."""
        self._parameters = dict(parameters)


class FileStore:
    """A JSON file, ``{"6072:00": "e803"}``; replaced as a whole: a crash leaves the old or the new."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def load(self) -> Parameters:
        """The file's parameters; empty without a file. Error: BadInput if it is no such file."""
        try:
            found = json.loads(self._path.read_text(encoding="ascii"))
            return {_key(name): bytes.fromhex(value) for name, value in found.items()}
        except FileNotFoundError:
            return {}
        except (ValueError, AttributeError, TypeError) as error:
            raise BadInput(
                str(self._path), "", str(error), "stored parameters", "delete the file to begin anew"
            ) from error

    def save(self, parameters: Parameters) -> None:
        """Write beside the file, then put in its place."""
        text = json.dumps(
            {f"{i:04X}:{s:02X}": raw.hex() for (i, s), raw in sorted(parameters.items())}, indent=0
        )
        beside = self._path.with_name(self._path.name + ".new")
        beside.write_text(text + "\n", encoding="ascii")
        os.replace(beside, self._path)


def _key(name: str) -> tuple[int, int]:
    index, subindex = name.split(":")
    return int(index, 16), int(subindex, 16)
