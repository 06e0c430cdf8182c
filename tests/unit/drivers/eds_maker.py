"""Small data sheets of drives, made to measure."""

from collections.abc import Iterable
from dataclasses import dataclass

from servobench.drivers.sheets.dictionary import LoadedDictionary, parse_dictionary

I8, I16, I32, U8, U16, U32 = 2, 3, 4, 5, 6, 7
NODE = 5

DRIVE = {
    0x6040: (U16, "rww"),
    0x6041: (U16, "ro"),
    0x6060: (I8, "rww"),
    0x6061: (I8, "ro"),
    0x6064: (I32, "ro"),
    0x606C: (I32, "ro"),
    0x6071: (I16, "rww"),
    0x6077: (I16, "ro"),
    0x607A: (I32, "rww"),
    0x60FF: (I32, "rww"),
}
"""The objects that a bench needs: type and access."""


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO of a data sheet."""

    index: int
    """Of its communication parameter."""
    mapping: tuple[int, ...] = ()
    writable: bool = True
    entries: int = 8
    kind: int = 255
    kind_access: str = "rw"
    cob_id_access: str = "rw"
    cob_id: str = ""
    timers: bool = True
    """It has an inhibit time and an event timer."""


def four_pdos(**how: object) -> list[Pdo]:
    """Four PDOs a direction, alike."""
    return [Pdo(base + number, **how) for base in (0x1400, 0x1800) for number in range(4)]  # type: ignore[arg-type]


def variable(index: int, data_type: int, access: str, default: str = "", mapping: int = 1) -> str:
    return (
        f"[{index:04X}]\nParameterName=Object {index:04X}\nObjectType=7\nDataType={data_type}\n"
        f"AccessType={access}\nDefaultValue={default}\nPDOMapping={mapping}\n"
    )


def sub(index: int, number: int, data_type: int, access: str, default: str) -> str:
    return (
        f"[{index:04X}sub{number:X}]\nParameterName=s{number}\nObjectType=7\nDataType={data_type}\n"
        f"AccessType={access}\nDefaultValue={default}\nPDOMapping=0\n"
    )


def pdo_text(pdo: Pdo) -> str:
    first = 0x180 if pdo.index >= 0x1800 else 0x200
    cob_id = pdo.cob_id or f"$NODEID+{first + 0x100 * (pdo.index & 0xFF):#x}"
    access = "rw" if pdo.writable else "ro"
    highest, members = ("5", 5) if pdo.timers else ("2", 3)
    text = f"[{pdo.index:04X}]\nParameterName=PDO\nObjectType=9\nSubNumber={members}\n"
    text += sub(pdo.index, 0, U8, "ro", highest) + sub(pdo.index, 1, U32, pdo.cob_id_access, cob_id)
    text += sub(pdo.index, 2, U8, pdo.kind_access, str(pdo.kind))
    if pdo.timers:
        text += sub(pdo.index, 3, U16, "rw", "0") + sub(pdo.index, 5, U16, "rw", "0")
    mapping = pdo.index + 0x200
    places = max(pdo.entries, len(pdo.mapping))
    text += f"[{mapping:04X}]\nParameterName=Mapping\nObjectType=9\nSubNumber={places + 1}\n"
    text += sub(mapping, 0, U8, access, str(len(pdo.mapping)))
    words = [*pdo.mapping, *[0] * (places - len(pdo.mapping))]
    return text + "".join(
        sub(mapping, number, U32, access, hex(word)) for number, word in enumerate(words, 1)
    )


def sheet_text(
    pdos: Iterable[Pdo],
    *,
    without: Iterable[int] = (),
    unmapped: Iterable[int] = (),
    also: str = "",
    device_type: str = "0x00020192",
    modes: str = "0x3ED",
) -> str:
    """A data sheet without its lists, which is one repair."""
    text = "[DeviceInfo]\nVendorName=Maker\nVendorNumber=0x123\n"
    text += variable(0x1000, U32, "ro", device_type, 0) + variable(0x1005, U32, "rw", "0x80", 0)
    text += "".join(pdo_text(pdo) for pdo in pdos)
    for index, (data_type, access) in DRIVE.items():
        if index not in set(without):
            text += variable(index, data_type, access, "", int(index not in set(unmapped)))
    if modes:
        text += variable(0x6502, U32, "ro", modes, 0)
    return text + also


def sheet(pdos: Iterable[Pdo], **how: object) -> LoadedDictionary:
    return parse_dictionary(sheet_text(pdos, **how).encode(), "made.eds", NODE)  # type: ignore[arg-type]
