"""Store parameters 1010h and restore default parameters 1011h (CiA 301, 7.5.2.13, 7.5.2.14).

    1  all
    2  communication, 1000h..1FFFh
    3  application, 6000h..9FFFh
    4  manufacturer, 2000h..5FFFh

Writing the signature "save" stores the present values of all that can be read and written, but for commands
and set-points; they then hold after power-on and resets.
Writing "load" forgets them; the defaults hold from the next power-on or reset on. Any other signature
is refused with 08000020h. What is stored goes to a :class:`ParameterStore`, which outlives a power cycle.
"""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from servobench.drivers.bounded_file import NoSuchFile, parse_json, read_text
from servobench.drivers.canopen.objects301 import FIRST_OBJECT, Cia301
from servobench.drivers.errors import BadInput, BenchError
from servobench.virtual_bus.device.object_dictionary import Check, ObjectDictionary, Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort, decode, encode

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")
ON_COMMAND = 1
"""Value of 1010h and 1011h: stores on command; restores."""

GROUPS = {
    1: range(FIRST_OBJECT, 0x10000),
    2: range(FIRST_OBJECT, 0x2000),
    3: range(0x6000, 0xA000),
    4: range(0x2000, 0x6000),
}
"""Indices of each sub-index."""

_NEVER_STORED = frozenset(
    {
        Cia301.ERROR_HISTORY,
        Cia301.STORE_PARAMETERS,
        Cia301.RESTORE_DEFAULTS,
        Cia301.HIGH_RESOLUTION_TIME_STAMP,
    }
)


Parameters = dict[tuple[int, int], bytes]
"""Raw bytes, as over SDO, by index and sub-index."""

_KEY = re.compile(r"([0-9A-Fa-f]{1,4}):([0-9A-Fa-f]{1,2})")
_EXPECTED = "stored parameters, a JSON object"
_REMEDY = "delete the file to begin anew"


class ParameterStore(Protocol):
    """Non-volatile memory."""

    def load(self) -> Parameters:
        """Return the last saved values; empty if there are none."""
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
        stored = parse_json(text, str(self._path), _EXPECTED)
        if not isinstance(stored, dict):
            raise BadInput(str(self._path), "", stored, _EXPECTED, _REMEDY)
        return dict(self._parameter(name, value) for name, value in stored.items())

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
        place = Path(os.path.realpath(self._path))  # a link stays one
        beside = place.with_name(place.name + ".new")
        beside.write_text(text + "\n", encoding="ascii")
        os.replace(beside, place)


class ParameterStorage:
    """Hooks 1010h and 1011h; the values go to a :class:`ParameterStore`."""

    def __init__(self, dictionary: ObjectDictionary, store: ParameterStore) -> None:
        self._dictionary = dictionary
        self._store = store
        for index, signature, act in (
            (Cia301.STORE_PARAMETERS, SAVE, self._save),
            (Cia301.RESTORE_DEFAULTS, LOAD, self._forget),
        ):
            if index not in dictionary:
                continue
            for subindex, variable in dictionary.object(index).members.items():
                if subindex:
                    variable.provider = lambda: ON_COMMAND
                    variable.check = _checker(signature, GROUPS.get(subindex, range(0)), act)

    def power_on(self) -> None:
        """Take the stored values; one that no longer fits its object is left alone."""
        for (index, subindex), raw in self._store.load().items():
            variable = self._dictionary.get(index, subindex)
            if variable is None or not _is_parameter(variable):
                continue
            try:
                value = decode(variable.data_type, raw)
            except SdoAbort:
                continue
            if variable.in_range(value):
                variable.power_on = value

    def _save(self, indices: range) -> None:
        kept = self._store.load()
        for variable in self._parameters(indices):
            kept[variable.index, variable.subindex] = encode(variable.data_type, variable.read())
        self._store.save(kept)
        for variable in self._parameters(indices):
            variable.power_on = variable.read()

    def _forget(self, indices: range) -> None:
        self._store.save({key: raw for key, raw in self._store.load().items() if key[0] not in indices})
        for variable in self._parameters(indices):
            variable.power_on = None

    def _parameters(self, indices: range) -> list[Variable]:
        return [
            variable
            for entry in self._dictionary
            if entry.index in indices
            for variable in entry.members.values()
            if _is_parameter(variable)
        ]


def _is_parameter(variable: Variable) -> bool:
    kept = variable.stored and variable.index not in _NEVER_STORED
    return kept and variable.readable and variable.writable


def _checker(signature: int, indices: range, act: Callable[[range], None]) -> Check:
    def check(value: int) -> AbortCode | None:
        if value != signature:
            return AbortCode.NOT_STORED
        try:
            act(indices)
        except (OSError, BenchError):
            return AbortCode.HARDWARE
        return None

    return check
