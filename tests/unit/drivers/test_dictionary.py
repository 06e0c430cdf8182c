"""The tolerant reader of dictionaries: one small file for each class of faults."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.dictionary import LoadedDictionary, load_dictionary, parse_dictionary
from drivers.errors import BadInput

SOUND = """[FileInfo]
FileName=sound.eds
[DeviceInfo]
VendorNumber=0x1234
BaudRate_1000=1
[DummyUsage]
Dummy0001=0
Dummy0002=1
Dummy0003=0
Dummy0004=0
Dummy0005=0
Dummy0006=0
Dummy0007=0
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
PDOMapping=0
[1800]
ParameterName=TPDO 1
ObjectType=0x9
SubNumber=2
[1800sub0]
ParameterName=Highest sub-index
ObjectType=0x7
DataType=0x0005
AccessType=const
DefaultValue=1
[1800sub1]
ParameterName=COB-ID
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x180
"""


def parse(text: str | bytes) -> LoadedDictionary:
    data = text if isinstance(text, bytes) else text.encode()
    return parse_dictionary(data, "test.eds", node_id=5)


def value(loaded: LoadedDictionary, index: int, sub: int = 0) -> object:
    variable = loaded.dictionary.get_variable(index, sub)
    assert variable is not None
    return variable.default


def repairs(loaded: LoadedDictionary) -> str:
    return "\n".join(map(str, loaded.repairs))


def test_a_sound_file_needs_no_repair() -> None:
    loaded = parse(SOUND)
    assert loaded.repairs == ()
    assert value(loaded, 0x1000) == 0x00020192
    assert value(loaded, 0x1800, 1) == 0x185


@pytest.mark.parametrize(
    ("old", "new", "telling"),
    [
        ("Device type", "Ger\x8atetyp \x94x\x94", "code page 1252"),
        ("[1800]\n", "[1000]\nDefaultValue=3\n[1800]\n", "the section occurs twice"),
        ("AccessType=ro", "AccessType=ro\nAccessType=rw", "AccessType occurs twice"),
        ("ObjectType=0x9", "ObjectType=0x9\nstray words", "no option: 'stray words'"),
        ("DataType=0x0007\nAccessType=ro", "DataType=\nAccessType=ro", "DataType is empty"),
        ("DataType=0x0007\nAccessType=ro", "DataType=0x0007", "AccessType is missing"),
        ("ParameterName=Device type\n", "", "ParameterName is missing"),
        ("PDOMapping=0", "PDOMapping=", "PDOMapping is empty"),
        ("[1800]\nParameterName=TPDO 1\nObjectType=0x9\nSubNumber=2\n", "", "not the object"),
        ("ObjectType=0x9", "ObjectType=0x7", "a variable with sub-objects"),
        ("BaudRate_1000=1", "BaudRate_1000=yes", "BaudRate_1000 is 'yes', no number"),
        ("SubNumber=2", "SubNumber=two", "SubNumber is 'two', no number"),
    ],
)
def test_each_fault_is_mended_and_told(old: str, new: str, telling: str) -> None:
    assert old in SOUND
    loaded = parse(SOUND.replace(old, new).encode("latin-1"))
    assert telling in repairs(loaded)
    assert loaded.dictionary.get_variable(0x1000) is not None
    assert value(loaded, 0x1800, 1) == 0x185


@pytest.mark.parametrize(
    ("written", "read"),
    [("192h", 0x192), ("0X192", 0x192), ("00402", 402), ("2019A", 0x2019A), ("1 000", 1000)],
)
def test_numbers_in_every_spelling(written: str, read: int) -> None:
    assert value(parse(SOUND.replace("0x00020192", written)), 0x1000) == read


@pytest.mark.parametrize(
    "written",
    ["0x180+$NODEID", "$NodeID + 180h", "$NODEID+384", "0x180 + $NODEID", "$NODE_ID+0x180", "180h+$nodeid"],
)
def test_node_id_in_every_spelling(written: str) -> None:
    assert value(parse(SOUND.replace("$NODEID+0x180", written)), 0x1800, 1) == 0x185


def test_an_empty_default_is_no_fault() -> None:
    loaded = parse(SOUND.replace("0x00020192", ""))
    assert loaded.repairs == ()
    assert value(loaded, 0x1000) is None


def test_comments_compact_objects_and_lower_case_are_no_faults() -> None:
    text = SOUND.replace("[1800sub1]", "; a comment\n[1800SUB01] ; another").replace(
        "AccessType", "accesstype"
    )
    text += "[Comments]\nLines=7\nLine1=x\n"
    text = text.replace("SubNumber=2", "SubNumber=2 ; of them\nCompactSubObj=0")
    loaded = parse(text)
    assert loaded.repairs == ()
    assert value(loaded, 0x1800, 1) == 0x185


def test_sub_objects_before_their_object() -> None:
    head, record, subs = SOUND.partition("[1800]\n")
    parent, _, rest = subs.partition("[1800sub0]\n")
    loaded = parse(head + "[1800sub0]\n" + rest + record + parent)
    assert value(loaded, 0x1800, 1) == 0x185


@pytest.mark.parametrize("data", [b"", b"\0" * 100, b"[FileInfo]\nFileName=x\n", b"not an EDS"])
def test_what_is_no_dictionary_is_bad_input(data: bytes) -> None:
    with pytest.raises(BadInput, match=r"test\.eds: found .*expected an EDS or DCF"):
        parse_dictionary(data, "test.eds")


def test_a_missing_file_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="No such file"):
        load_dictionary(tmp_path / "none.eds")


@settings(derandomize=True, deadline=None, max_examples=300)
@given(st.integers(0, len(SOUND) - 1), st.integers(0, 60), st.binary(max_size=6))
def test_no_damage_is_anything_but_repairs_or_bad_input(start: int, length: int, patch: bytes) -> None:
    data = SOUND.encode()
    damaged = data[:start] + patch + data[start + length :]
    try:
        loaded = parse(damaged)
    except BadInput:
        return
    assert isinstance(loaded, LoadedDictionary)
