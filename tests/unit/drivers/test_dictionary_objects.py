"""The tolerant reader of dictionaries: short forms, missing parts, values of every type, and DCFs."""

import pytest

from tests.unit.drivers.sound_sheet import SOUND, parse, repairs, value


def test_compact_objects_with_names_and_values() -> None:
    text = SOUND + "[1003Name]\nNrOfEntries=1\n2=Second\n[1003Value]\nNrOfEntries=3\n1=0x10\n4=20\n"
    loaded = parse(text)
    names = [loaded.objects[0x1003].entries[sub].name for sub in range(5)]
    assert names == ["Number of entries", "Error field1", "Second", "Error field3", "Error field4"]
    assert [value(loaded, 0x1003, sub) for sub in range(5)] == [4, 0x10, None, None, 20]
    (repair,) = loaded.repairs
    assert repair.fault == "NrOfEntries is 3, 2 are there"


def test_entries_beyond_a_compact_object_and_tables_without_one() -> None:
    text = SOUND + "[1003Value]\nNrOfEntries=1\n9=1\n[2000Value]\nNrOfEntries=0\n"
    told = repairs(parse(text))
    assert "entry 9 is beyond the object" in told
    assert "[2000Value] no compact object has this table" in told


def test_compact_pdos() -> None:
    text = SOUND.replace(
        "[DummyUsage]", "NrOfTXPDO=5\nNrOfRXPDO=1\nCompactPDO=0x13\nGranularity=8\n[DummyUsage]"
    )
    loaded = parse(text)
    assert value(loaded, 0x1800, 1) == 0x185  # defined in the file: it stays
    assert value(loaded, 0x1801, 1) == 0x285
    assert value(loaded, 0x1804, 1) == 0x80000000
    assert value(loaded, 0x1400, 1) == 0x205
    assert sorted(loaded.objects[0x1801].entries) == [0, 1, 2, 5]
    assert len(loaded.objects[0x1A04].entries) == 9


def test_a_missing_sub_index_0_is_made() -> None:
    start, end = SOUND.index("[607Dsub0]"), SOUND.index("[607Dsub1]")
    loaded = parse(SOUND[:start] + SOUND[end:])
    assert value(loaded, 0x607D, 0) == 2
    assert "sub-object 0 is missing" in repairs(loaded)


def test_arrays_and_records_without_sub_objects() -> None:
    like_its_head = (
        "[2001]\nParameterName=A\nObjectType=8\nSubNumber=3\nDataType=6\nAccessType=rw\nDefaultValue=7\n"
    )
    loaded = parse(SOUND + like_its_head + "[2002]\nParameterName=B\nObjectType=9\n")
    assert [value(loaded, 0x2001, sub) for sub in range(3)] == [2, 7, 7]
    assert 0x2002 not in loaded.dictionary
    told = repairs(loaded)
    assert "an array without sub-objects: given 2 like its head" in told
    assert "a record of which no sub-object is defined: left out" in told


def test_a_limit_of_the_consumer_heartbeat_that_forgets_the_node_id() -> None:
    text = "[1016]\nParameterName=H\nObjectType=8\nSubNumber=2\n"
    text += "[1016sub0]\nParameterName=n\nDataType=5\nAccessType=ro\nDefaultValue=1\n"
    text += "[1016sub1]\nParameterName=h\nDataType=7\nAccessType=rw\nLowLimit=0\nHighLimit=65535\n"
    loaded = parse(SOUND + text)
    assert loaded.objects[0x1016].entries[1].high is None
    assert "leaves no room for a node-ID" in repairs(loaded)


def test_a_section_without_options_is_what_the_standard_says() -> None:
    loaded = parse(SOUND + "[6040]\n[2345]\n")
    variable = loaded.dictionary.get_variable(0x6040)
    assert variable is not None
    assert variable.data_type == 6
    assert 0x2345 not in loaded.dictionary


def test_a_type_that_an_editor_defined() -> None:
    text = SOUND + "[A0]\nObjectType=6\n[A0sub1]\nDefaultValue=0x0006\n"
    loaded = parse(text + "[2001]\nParameterName=L\nObjectType=7\nDataType=0x00A0\nAccessType=rw\n")
    variable = loaded.dictionary.get_variable(0x2001)
    assert variable is not None
    assert variable.data_type == 6


@pytest.mark.parametrize(
    ("data_type", "written", "read"),
    [
        (0x08, "1.5", 1.5),
        (0x08, "1,5", 1.5),
        (0x08, "0x3FC00000", 1.5),
        (0x11, "-2e3", -2000.0),
        (0x01, "true", 1),
        (0x0A, "01 02 FF", b"\x01\x02\xff"),
        (0x0F, "0x0102", b"\x01\x02"),
        (0x0F, "no octets", None),
        (0x16, "0xFFFFFF", 0xFFFFFF),
        (0x10, "0xFFFFFF", -1),
        (0x15, "-1", -1),
        (0x1B, "0xFFFFFFFFFFFFFFFF", 2**64 - 1),
    ],
)
def test_values_of_every_kind_of_type(data_type: int, written: str, read: object) -> None:
    text = f"[2001]\nParameterName=V\nDataType={data_type}\nAccessType=rw\nDefaultValue={written}\n"
    assert value(parse(SOUND + text), 0x2001) == read


DCF = (
    SOUND.replace("DefaultValue=1000", "DefaultValue=1000\nParameterValue=2000\nDenotation=the upper stop")
    + "[DeviceComissioning]\nNodeID=0x07\nNodeName=axis\nBaudrate=500\nLSS_SerialNumber=0x11\n"
)


def test_a_dcf_tells_its_node_and_its_values() -> None:
    loaded = parse(DCF, None)
    assert loaded.commissioning is not None
    assert (loaded.commissioning.node_id, loaded.commissioning.bit_rate_kbit_s) == (7, 500)
    assert value(loaded, 0x1800, 1) == 0x187
    variable = loaded.dictionary.get_variable(0x607D, 2)
    assert variable is not None
    assert (variable.default, variable.value) == (1000, 2000)
    assert loaded.objects[0x607D].entries[2].denotation == "the upper stop"
    assert value(parse(DCF, 9), 0x1800, 1) == 0x189


def test_the_commissioning_section_in_its_right_spelling() -> None:
    loaded = parse(DCF.replace("DeviceComissioning", "DeviceCommissioning"), None)
    assert loaded.commissioning is not None
    assert loaded.commissioning.node_id == 7
    assert parse(DCF.replace("NodeID=0x07", "NodeID=200"), None).commissioning.node_id is None  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("written", "on_node_9", "follows"),
    [
        ("0x187", 0x189, True),
        ("0xC0000187", 0xC0000189, True),
        ("0x1FF", 0x1FF, False),
        ("$NODEID+0x200", 0x209, True),
    ],
)
def test_an_identifier_of_a_dcf_that_is_nobodys_setting_follows_the_node(
    written: str, on_node_9: int, follows: bool
) -> None:
    text = DCF.replace("DefaultValue=$NODEID+0x180", f"DefaultValue=$NODEID+0x180\nParameterValue={written}")
    variable = parse(text, 9).dictionary.get_variable(0x1800, 1)
    assert variable is not None
    assert (variable.value, variable.relative) == (on_node_9, follows)


def test_values_of_a_compact_object_in_a_dcf_are_what_is_configured() -> None:
    loaded = parse(DCF + "[1003Value]\nNrOfEntries=1\n2=5\n[1003Denotation]\nNrOfEntries=1\n2=front\n", None)
    variable = loaded.dictionary.get_variable(0x1003, 2)
    assert variable is not None
    assert (variable.default, variable.value) == (None, 5)
    assert loaded.objects[0x1003].entries[2].denotation == "front"
