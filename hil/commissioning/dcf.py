"""What was set in a drive as a device configuration file (CiA 306-1)."""

from collections.abc import Iterable
from typing import Any, Final

from canopen.objectdictionary import ObjectDictionary, ODVariable

from drivers.canopen.objects301 import MANDATORY, MANUFACTURER
from drivers.cia402.drive_setup import Identity
from hil.restoring.journal import ObjectKey

_UNSIGNED: Final = {1: 0x05, 2: 0x06, 4: 0x07, 8: 0x1B}
_SIGNED_TYPES: Final = {0x02: 1, 0x03: 2, 0x04: 4, 0x15: 8}
_OCTETS: Final = 0x0A


def dcf_text(
    values: dict[ObjectKey, bytes],
    defaults: dict[ObjectKey, bytes],
    dictionary: ObjectDictionary | None,
    node: int,
    bitrate_bit_s: int,
    identity: Identity | None,
) -> str:
    """A DCF with ``values`` as ParameterValue and what was there before as DefaultValue.

    ``defaults`` of mandatory objects are written even if they were not set.
    """
    shown: dict[ObjectKey, bytes | None] = {key: None for key in defaults if key.index in MANDATORY}
    shown |= values
    indices = sorted({key.index for key in shown})
    lines = [
        *_section("FileInfo", {"FileName": "drive.dcf", "FileVersion": 1, "EDSVersion": "4.0"}),
        *_section("DeviceInfo", _device(identity)),
        *_section(
            "DeviceComissioning", {"NodeID": node, "Baudrate": bitrate_bit_s // 1000, "NodeName": "drive"}
        ),
    ]
    for title, members in (
        ("MandatoryObjects", [index for index in indices if index in MANDATORY]),
        ("OptionalObjects", [i for i in indices if i not in MANDATORY and i not in MANUFACTURER]),
        ("ManufacturerObjects", [index for index in indices if index in MANUFACTURER]),
    ):
        listed = {str(number): f"0x{index:04X}" for number, index in enumerate(members, start=1)}
        lines += _section(title, {"SupportedObjects": len(members), **listed})
    for index in indices:
        own = {key: value for key, value in shown.items() if key.index == index}
        lines += _object(index, own, defaults, dictionary)
    return "\n".join(lines) + "\n"


def _device(identity: Identity | None) -> dict[str, Any]:
    if identity is None:
        return {}
    return {
        "ProductName": identity.device_name,
        "VendorNumber": f"0x{identity.vendor:08X}",
        "ProductNumber": f"0x{identity.product:08X}",
        "RevisionNumber": f"0x{identity.revision:08X}",
    }


def _object(
    index: int,
    values: dict[ObjectKey, bytes | None],
    defaults: dict[ObjectKey, bytes],
    dictionary: ObjectDictionary | None,
) -> Iterable[str]:
    entry: Any = dictionary.get(index) if dictionary is not None else None
    plain = isinstance(entry, ODVariable) or (entry is None and all(key.sub == 0 for key in values))
    if plain:
        key = ObjectKey(index, 0)
        yield from _variable(f"{index:04X}", f"Object {index:04X}h", values[key], defaults.get(key), entry)
        return
    name = getattr(entry, "name", f"Object {index:04X}h")
    yield from _section(
        f"{index:04X}", {"ParameterName": name, "ObjectType": "0x9", "SubNumber": len(values)}
    )
    for key, value in sorted(values.items()):
        member = entry.subindices.get(key.sub) if entry is not None else None
        title = f"{index:04X}sub{key.sub:X}"
        yield from _variable(title, f"Sub-index {key.sub}", value, defaults.get(key), member)


def _variable(title: str, name: str, value: bytes | None, default: bytes | None, entry: Any) -> list[str]:
    width = len(value if value is not None else default or b"")
    data_type = getattr(entry, "data_type", None) or _UNSIGNED.get(width, _OCTETS)
    entries: dict[str, Any] = {
        "ParameterName": getattr(entry, "name", name),
        "ObjectType": "0x7",
        "DataType": f"0x{data_type:04X}",
        "AccessType": getattr(entry, "access_type", "rw" if value is not None else "ro"),
        "DefaultValue": "" if default is None else _text(default, data_type),
    }
    if value is not None:
        entries["ParameterValue"] = _text(value, data_type)
    return _section(title, {**entries, "PDOMapping": 0})


def _text(value: bytes, data_type: int) -> str:
    if data_type == _OCTETS:
        return value.hex()
    signed = data_type in _SIGNED_TYPES
    number = int.from_bytes(value, "little", signed=signed)
    return str(number) if signed else f"0x{number:X}"


def _section(title: str, entries: dict[str, Any]) -> list[str]:
    return [f"[{title}]", *(f"{key}={value}" for key, value in entries.items()), ""]
