"""XDD and XDC (CiA 311): the same dictionary as the EDS and DCF of the same device."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput
from servobench.drivers.sheets.dictionary import LoadedDictionary, parse_dictionary
from servobench.hil.cli import app
from tests.unit.drivers.made_xdd import COMMISSIONED, HEAD, OBJECTS, xdd_text
from tests.unit.drivers.sound_sheet import parse, repairs, value

EDS = """[FileInfo]
FileName=a.xdd
FileVersion=3
CreationDate=2024-05-06
[DeviceInfo]
VendorName=Maker
VendorNumber=0x123
ProductName=Drive
ProductNumber=77
BaudRate_500=1
BaudRate_1000=1
Granularity=8
NrOfRXPDO=1
NrOfTXPDO=1
SimpleBootUpSlave=1
LSS_Supported=0
[DummyUsage]
Dummy0005=1
Dummy0006=0
[MandatoryObjects]
SupportedObjects=1
1=0x1000
[OptionalObjects]
SupportedObjects=4
1=0x1800
2=0x6040
3=0x6060
4=0x6064
[ManufacturerObjects]
SupportedObjects=2
1=0x2000
2=0x2001
[1800]
ParameterName=TPDO 1
ObjectType=0x9
SubNumber=3
"""
ENTRIES = [
    ("1000", "Device type", 7, "ro", "0x00020192", 0, ""),
    ("1800sub0", "Highest", 5, "const", "2", 0, ""),
    ("1800sub1", "COB-ID", 7, "rw", "$NODEID+0x180", 0, "ObjFlags=1"),
    ("1800sub2", "Type", 5, "rw", "255", 0, ""),
    ("6040", "Controlword", 6, "rww", "0", 1, "LowLimit=0\nHighLimit=0xFFFF"),
    ("6060", "Modes", 2, "rww", "-1", 1, "LowLimit=-128\nHighLimit=10"),
    ("6064", "Position", 4, "ro", "", 1, ""),
    ("2000", "Gain", 8, "rw", "1.5", 0, ""),
    ("2001", "Note", 9, "rw", "a = b", 0, ""),
]


def eds_text(also: str = "") -> str:
    return (
        EDS
        + also
        + "".join(
            f"[{name}]\nParameterName={title}\nObjectType=7\nDataType={kind}\nAccessType={access}\n"
            + (f"DefaultValue={default}\n" if default else "")
            + f"PDOMapping={mapping}\n{more}\n"
            for name, title, kind, access, default, mapping, more in ENTRIES
        )
    )


def xdd(text: str, node_id: int | None = 5) -> LoadedDictionary:
    return parse_dictionary(text.encode(), "made.xdd", node_id)


def facts(loaded: LoadedDictionary) -> dict[object, object]:
    """All that a dictionary says, but the spelling of numbers."""
    return {
        (index, sub): (
            entry.name,
            entry.data_type,
            entry.access,
            entry.mappable,
            entry.default.at(5),
            entry.configured.at(5),
            entry.low,
            entry.high,
            entry.flags,
        )
        for index, made in loaded.objects.items()
        for sub, entry in made.entries.items()
    }


def test_an_xdd_and_the_eds_of_the_same_device_give_the_same_dictionary() -> None:
    one, other = xdd(xdd_text()), parse(eds_text())
    assert facts(one) == facts(other)
    assert (one.device, one.file, one.dummies) == (other.device, other.file, other.dummies)
    assert (one.repairs, other.repairs) == ((), ())
    assert (one.kind, other.kind) == ("XDD", "EDS")
    assert len(facts(one)) == len(ENTRIES)


def test_an_xdc_is_a_dcf() -> None:
    actual = OBJECTS.replace('defaultValue="255"', 'defaultValue="255" actualValue="1"')
    one = xdd(xdd_text(actual, COMMISSIONED), None)
    section = "[DeviceComissioning]\nNodeID=9\nNodeName=axis\nBaudrate=500\nNetNumber=2\n"
    other = parse(eds_text(section).replace("DefaultValue=255", "DefaultValue=255\nParameterValue=1"), None)
    assert facts(one) == facts(other)
    assert one.commissioning == other.commissioning
    assert one.kind == "XDC"
    assert value(one, 0x1800, 1) == value(other, 0x1800, 1) == 0x189
    assert one.dictionary.get_variable(0x1800, 2).value == 1  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (
            HEAD.replace("<ISO", '<!DOCTYPE a [<!ENTITY b "c">]>\n<ISO') + "</ISO15745ProfileContainer>",
            "document type",
        ),
        (HEAD + "<a>&b;</a></ISO15745ProfileContainer>", "undefined entity"),
        (HEAD + "<a></ISO15745ProfileContainer>", "mismatched tag"),
        (HEAD + "<a>" * 64, "more than 64 elements in one another"),
        ("<EtherCATInfo/>", "root element 'EtherCATInfo'.*ask for an EDS"),
        (HEAD + "</ISO15745ProfileContainer>", "no CANopenObject"),
        ("<", "unclosed token"),
    ],
    ids=["entities", "unknown entity", "torn", "deep", "EtherCAT", "empty", "cut"],
)
def test_other_xml_is_refused_by_what_it_is(text: str, found: str) -> None:
    with pytest.raises(BadInput, match=rf"made\.xdd.*{found}"):
        xdd(text)


def declared(encoding: str) -> str:
    return xdd_text(OBJECTS.replace("Controlword", "Gr\xf6\xdfe")).replace("utf-8", encoding)


@pytest.mark.parametrize("encoding", ["utf-8", "UTF-16", "iso-8859-1", "windows-1252", "ISO-8859-15"])
def test_a_sheet_is_read_in_the_encoding_that_it_declares(encoding: str) -> None:
    found = parse_dictionary(declared(encoding).encode(encoding), "made.xdd", 5)
    assert found.dictionary[0x6040].name == "Gr\xf6\xdfe"


@pytest.mark.parametrize("encoding", ["utf-true", "hex", "utf-7", "idna", "shift_jis"])
def test_an_encoding_that_is_none_is_refused(encoding: str) -> None:
    """Python's codecs fail within Expat, each in its own way: found by a mutated file."""
    with pytest.raises(BadInput, match=rf"made\.xdd.*line 1.*an encoding '{encoding}'"):
        xdd(declared(encoding))


def test_names_do_nothing_to_a_terminal() -> None:
    found = xdd(xdd_text(OBJECTS.replace("Controlword", "a&#x202e;b&#x9b;1m")))
    assert found.dictionary[0x6040].name == "a\\u202eb\\x9b1m"


def test_faults_are_mended_and_told() -> None:
    odd = OBJECTS.replace('index="6064"', 'index="x"').replace('index="2001"', 'index="2000"')
    found = xdd(xdd_text(odd.replace('accessType="rw" defaultValue="0"', 'defaultValue="0"')))
    assert "an object without an index: left out" in repairs(found)
    assert "the object occurs twice" in repairs(found)
    assert "AccessType is missing" in repairs(found)


def test_commands_take_it(tmp_path: Path) -> None:
    path = tmp_path / "drive.xdd"
    path.write_text(xdd_text())
    done = CliRunner().invoke(app, ["eds", str(path)])
    assert "XDD" in done.stdout
    assert "Drive" in done.stdout
