"""The simulated drive's own data sheet under another maker's name, to be changed trait by trait."""

import configparser
import io
from collections.abc import Iterable, Mapping

from servobench.drivers.canopen.objects301 import DataType
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING

VENDOR, PRODUCT, REVISION = 0x0A11, 0x0B22, 0x0C33
LISTS = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")


class MadeSheet:
    """An EDS as sections with options."""

    def __init__(self) -> None:
        self._sections = configparser.RawConfigParser(strict=False)
        self._sections.optionxform = str  # type: ignore[method-assign,assignment]
        self._sections.read_string(export_eds(SimulatedServo(1, LING).dictionary))
        for name in LISTS:  # they would have to follow each change; a file without is read with a remark
            self._sections.remove_section(name)
        for name, value in (("Vendor", VENDOR), ("Product", PRODUCT), ("Revision", REVISION)):
            self.inform(f"{name}Number", f"0x{value:X}")
        for sub, value in enumerate((VENDOR, PRODUCT, REVISION), start=1):
            self.set(0x1018, sub, default=f"0x{value:X}")

    def drop(self, *indices: int) -> None:
        """Take objects out with all that they have, and out of the default mappings."""
        for index in indices:
            for name in [name for name in self._sections if name[:4] == f"{index:04X}"]:
                self._sections.remove_section(name)
        for base in (0x1600, 0x1A00):
            for index in range(base, base + 4):
                words = [word for word in self.mapping(index) if word >> 16 not in indices]
                self.map(index, words)

    def has(self, index: int) -> bool:
        """The object is there."""
        return f"{index:04X}" in self._sections

    def drop_sub(self, index: int, sub: int) -> None:
        """Take a sub-index out, if it is there."""
        self._sections.remove_section(f"{index:04X}sub{sub:X}")

    def set(
        self, index: int, sub: int | None = None, *, default: int | str | None = None, **options: object
    ) -> None:
        """Change options of an object that is there; None leaves DefaultValue as it is."""
        section = self._sections[f"{index:04X}" if sub is None else f"{index:04X}sub{sub:X}"]
        if default is not None:
            section["DefaultValue"] = str(default)
        for name, value in options.items():
            section[name] = str(value)

    def add(self, index: int, types: Mapping[int, DataType]) -> None:
        """An object of the maker's, by sub-index: a record, or a variable if it has but sub-index 0."""
        section = f"{index:04X}"
        every = dict(types)
        if set(types) != {0}:
            self._sections[section] = {"ParameterName": "made", "ObjectType": "0x9"}
            every[0] = DataType.UNSIGNED8
        for sub, kind in every.items():
            self._sections[section if every.keys() == {0} else f"{section}sub{sub:X}"] = {
                "ParameterName": f"made {sub}",
                "ObjectType": "0x7",
                "DataType": f"0x{kind:04X}",
                "AccessType": "rw",
                "PDOMapping": "0",
                "DefaultValue": str(0 if sub else max(types)),
            }

    def by(self, vendor: int) -> None:
        """Make it another maker's."""
        self.inform("VendorNumber", f"0x{vendor:X}")
        if "1018sub1" in self._sections:
            self.set(0x1018, 1, default=f"0x{vendor:X}")

    def inform(self, name: str, value: object) -> None:
        """Change an option of [DeviceInfo]."""
        self._sections["DeviceInfo"][name] = str(value)

    def mapping(self, index: int) -> list[int]:
        """The words of a default mapping; empty if there is no such PDO."""
        if f"{index:04X}sub0" not in self._sections:
            return []
        count = int(self._sections[f"{index:04X}sub0"]["DefaultValue"])
        return [int(self._sections[f"{index:04X}sub{n:X}"]["DefaultValue"]) for n in range(1, count + 1)]

    def map(self, index: int, words: Iterable[int], access: str | None = None) -> None:
        """Make it the default mapping; ``ro``: for good, None: as it was."""
        if f"{index:04X}sub0" not in self._sections:
            return
        held = list(words)
        access = access or self._sections[f"{index:04X}sub0"]["AccessType"]
        self.set(index, 0, default=len(held), AccessType=access)
        for number in range(1, 9):
            word = held[number - 1] if number <= len(held) else 0
            self.set(index, number, default=word, AccessType=access)

    def every(self, sub: int, bases: Iterable[int], **options: object) -> None:
        """Change options of the same sub-index of four PDO parameters each."""
        for base in bases:
            for index in range(base, base + 4):
                if f"{index:04X}sub{sub:X}" in self._sections:
                    self.set(index, sub, **options)  # type: ignore[arg-type]

    def touched(self, before: "MadeSheet") -> frozenset[int]:
        """Objects of which something is otherwise than in ``before``."""
        names = {name for name in (*self._sections, *before._sections) if name[:1].isdigit()}
        return frozenset(
            int(name[:4], 16)
            for name in names
            if dict(self._sections.items(name) if name in self._sections else ())
            != dict(before._sections.items(name) if name in before._sections else ())
        )

    def text(self) -> str:
        """The file."""
        file = io.StringIO()
        self._sections.write(file, space_around_delimiters=False)
        return file.getvalue()
