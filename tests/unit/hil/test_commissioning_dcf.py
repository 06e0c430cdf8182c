"""A device configuration file of what a drive was set to (CiA 306-1), by hand."""

from canopen.objectdictionary import ObjectDictionary as Dictionary
from canopen.objectdictionary import ODArray, ODVariable

from servobench.hil.commissioning.files import dcf_text
from servobench.hil.restoring.journal import ObjectKey
from tests.unit.hil.test_commissioning_files import IDENTITY


def sections(text: str) -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {}
    for line in text.splitlines():
        if line.startswith("["):
            found[line[1:-1]] = {}
        elif line:
            key, _, value = line.partition("=")
            found[list(found)[-1]][key] = value
    return found


def test_a_configuration_file_by_hand() -> None:
    """Without a data sheet a type is guessed by its width."""
    values = {
        ObjectKey(0x6085, 0): b"\x10\x27\0\0",
        ObjectKey(0x1017, 0): b"\x32\0",
        ObjectKey(0x2000, 0): b"\x01\x02\x03",
        ObjectKey(0x607D, 2): b"\xff\xff\xff\xff",
        ObjectKey(0x607D, 1): b"\x00\x00\x00\x80",
    }
    defaults = {ObjectKey(0x1000, 0): b"\x92\1\2\0", ObjectKey(0x1017, 0): b"\0\0", ObjectKey(0x6040, 0): b""}
    found = sections(dcf_text(values, defaults, None, 5, 500_000, IDENTITY))
    plain = {"ObjectType": "0x7", "AccessType": "rw", "PDOMapping": "0"}
    assert found == {
        "FileInfo": {"FileName": "drive.dcf", "FileVersion": "1", "EDSVersion": "4.0"},
        "DeviceInfo": {
            "ProductName": "a drive",
            "VendorNumber": "0x00000007",
            "ProductNumber": "0x00000008",
            "RevisionNumber": "0x00000001",
        },
        "DeviceComissioning": {"NodeID": "5", "Baudrate": "500", "NodeName": "drive"},
        "MandatoryObjects": {"SupportedObjects": "1", "1": "0x1000"},
        "OptionalObjects": {"SupportedObjects": "3", "1": "0x1017", "2": "0x607D", "3": "0x6085"},
        "ManufacturerObjects": {"SupportedObjects": "1", "1": "0x2000"},
        "1000": plain | {
            "ParameterName": "Object 1000h", "DataType": "0x0007", "AccessType": "ro",
            "DefaultValue": "0x20192",
        },
        "1017": plain | {
            "ParameterName": "Object 1017h", "DataType": "0x0006", "DefaultValue": "0x0",
            "ParameterValue": "0x32",
        },
        "2000": plain | {
            "ParameterName": "Object 2000h", "DataType": "0x000A", "DefaultValue": "",
            "ParameterValue": "010203",
        },
        "607D": {"ParameterName": "Object 607Dh", "ObjectType": "0x9", "SubNumber": "2"},
        "607Dsub1": plain | {
            "ParameterName": "Sub-index 1", "DataType": "0x0007", "DefaultValue": "",
            "ParameterValue": "0x80000000",
        },
        "607Dsub2": plain | {
            "ParameterName": "Sub-index 2", "DataType": "0x0007", "DefaultValue": "",
            "ParameterValue": "0xFFFFFFFF",
        },
        "6085": plain | {
            "ParameterName": "Object 6085h", "DataType": "0x0007", "DefaultValue": "",
            "ParameterValue": "0x2710",
        },
    }  # fmt: skip


def test_a_data_sheet_names_objects_and_their_types() -> None:
    dictionary = Dictionary()  # type: ignore[no-untyped-call]
    array = ODArray("Software position limit", 0x607D)
    least = ODVariable("Min position limit", 0x607D, 1)
    least.data_type, least.access_type = 4, "rww"
    array.add_member(least)
    dictionary.add_object(array)
    option = ODVariable("Quick stop option code", 0x605A)
    option.data_type = 3
    dictionary.add_object(option)
    values = {ObjectKey(0x607D, 1): b"\xfe\xff\xff\xff", ObjectKey(0x605A, 0): b"\xff\xff"}
    found = sections(dcf_text(values, {ObjectKey(0x605A, 0): b"\x02\0"}, dictionary, 1, 1_000_000, IDENTITY))
    assert found["607D"] == {
        "ParameterName": "Software position limit",
        "ObjectType": "0x9",
        "SubNumber": "1",
    }
    assert found["607Dsub1"] == {
        "ParameterName": "Min position limit",
        "ObjectType": "0x7",
        "DataType": "0x0004",
        "AccessType": "rww",
        "DefaultValue": "",
        "ParameterValue": "-2",
        "PDOMapping": "0",
    }
    assert found["605A"]["ParameterName"] == "Quick stop option code"
    assert (found["605A"]["DefaultValue"], found["605A"]["ParameterValue"]) == ("2", "-1")
    assert found["DeviceComissioning"]["Baudrate"] == "1000"
