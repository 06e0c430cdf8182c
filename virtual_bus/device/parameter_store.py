"""Where a device keeps its stored parameters over a power cycle."""

import json
import os
import re
from pathlib import Path
from typing import Protocol

from drivers.bounded_file import NoSuchFile, parse_json, read_text
from drivers.errors import BadInput

Parameters = dict[tuple[int, int], bytes]
"""Raw bytes, as over SDO, by index and sub-index."""

_KEY = re.compile(r"([0-9A-Fa-f]{1,4}):([0-9A-Fa-f]{1,2})")
_EXPECTED = "stored parameters, a JSON object"
_REMEDY = "delete the file to begin anew"


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
            text = read_text(self._path, "file of stored parameters")
        except NoSuchFile:
            return {}
        found = parse_json(text, str(self._path), _EXPECTED)
        if not isinstance(found, dict):
            raise BadInput(str(self._path), "", found, _EXPECTED, _REMEDY)
        return dict(self._parameter(name, value) for name, value in found.items())

    def _parameter(self, name: str, value: object) -> tuple[tuple[int, int], bytes]:
        match = _KEY.fullmatch(name)
        if match is None:
            raise BadInput(str(self._path), name, value, 'a key such as "6072:00"', _REMEDY)
        try:
            return (int(match[1], 16), int(match[2], 16)), bytes.fromhex(str(value))
        except ValueError:
            raise BadInput(str(self._path), name, value, 'octets such as "e803"', _REMEDY) from None

    def save(self, parameters: Parameters) -> None:
        """Write beside the file, then put in its place."""
        text = json.dumps(
            {f"{i:04X}:{s:02X}": raw.hex() for (i, s), raw in sorted(parameters.items())}, indent=0
        )
        beside = self._path.with_name(self._path.name + ".new")
        beside.write_text(text + "\n", encoding="ascii")
        os.replace(beside, self._path)
