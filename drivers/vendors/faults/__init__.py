"""What makers mean by the error codes of their drives, each with its source.

One TOML file a family of drives: ``vendor`` (1018h:1), optionally ``device_name`` (the beginning of 1008h),
``source``, ``[codes]`` with codes or ranges of codes as keys, and ``[numbers]`` with what a maker puts
into the upper octet of 1003h.
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from drivers.errors import BadInput


@dataclass(frozen=True, slots=True)
class VendorCodes:
    """What one family of drives means by its codes."""

    vendor: int
    device_name: str
    source: str
    texts: dict[range, str]
    numbers: dict[int, str]
    """Bits 24 to 31 of an entry of 0x1003, for makers that tell the cause there."""

    def text(self, code: int) -> str | None:
        """The vendor's text; None for a code that its table does not have."""
        return next((text for codes, text in self.texts.items() if code in codes), None)


@cache
def vendor_tables() -> tuple[VendorCodes, ...]:
    """All tables of this folder, by name."""
    found = sorted(files(__name__).iterdir(), key=lambda path: path.name)
    return tuple(
        read_vendor_codes(path.read_text(encoding="utf-8"), path.name)
        for path in found
        if path.name.endswith(".toml")
    )


def read_vendor_codes(text: str, name: str) -> VendorCodes:
    """A table's content. Raises BadInput for one without vendor or source, and for a key that is no code."""
    tables = tomllib.loads(text)
    for key, expected in (("vendor", "the vendor-ID of 1018h:1"), ("source", "where the codes stand")):
        if not tables.get(key):
            raise BadInput(name, key, tables.get(key), expected)
    texts = {_codes(key, name): str(value) for key, value in tables.get("codes", {}).items()}
    source = " ".join(str(tables["source"]).split())
    numbers = {int(key): str(value) for key, value in tables.get("numbers", {}).items()}
    return VendorCodes(int(tables["vendor"]), str(tables.get("device_name", "")), source, texts, numbers)


def _codes(key: str, name: str) -> range:
    """``7380`` or ``6180-61F0``, hexadecimal."""
    first, _, last = key.partition("-")
    try:
        return range(int(first, 16), int(last or first, 16) + 1)
    except ValueError:
        raise BadInput(name, f"codes.{key}", key, "a hexadecimal code, or two with - between") from None


def codes_of(vendor: int, device_name: str) -> list[VendorCodes]:
    """The tables of the families that a drive may belong to."""
    name = device_name.upper()
    return [
        table
        for table in vendor_tables()
        if table.vendor == vendor and name.startswith(table.device_name.upper())
    ]
