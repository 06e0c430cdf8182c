"""The tolerant reader of dictionaries: one small file for each class of faults."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.errors import BadInput
from servobench.drivers.sheets.dictionary import LoadedDictionary, load_dictionary, parse_dictionary
from tests.draws import examples_of
from tests.unit.drivers.sound_sheet import SOUND, line_of, parse, repairs, value


def test_a_sound_file_needs_no_repair() -> None:
    loaded = parse(SOUND)
    assert loaded.repairs == ()
    assert value(loaded, 0x1000) == 0x00020192
    assert value(loaded, 0x1800, 1) == 0x185
    assert value(loaded, 0x607D, 1) == -(2**31)
    assert value(loaded, 0x2000) == "a = b"
    assert loaded.device.vendor_number == 0x1234
    assert loaded.device.bit_rates_kbit_s == (1000,)
    assert loaded.dummies == (2,)


def test_what_a_file_says_of_itself_its_device_and_its_node_is_read_by_key() -> None:
    """The keys are those of CiA 306-1; each has another value."""
    text = SOUND.replace(
        "FileName=sound.eds\n",
        "FileName=sound.eds\nFileVersion=3\nFileRevision=7\nEDSVersion=4.0\nDescription=a drive\n"
        "CreationDate=01-02-2003\nCreationTime=04:05AM\nModificationDate=06-07-2008\n",
    )
    rates = (10, 20, 50, 125, 250, 500, 800, 1000)
    device = "VendorName=Maker\nProductName=Drive\nOrderCode=D-1\nProductNumber=0x77\nRevisionNumber=5\n"
    device += "NrOfRXPDO=6\nNrOfTXPDO=9\nGranularity=8\nCompactPDO=3\nLSS_Supported=1\nSimpleBootUpSlave=0\n"
    node = "[DeviceComissioning]\nNodeID=5\nNodeName=left\nBaudrate=500\nNetNumber=2\n"
    node += "NetworkName=lab\nLSS_SerialNumber=0x99\n"
    loaded = parse(text.replace("BaudRate_1000=1\n", device + "BaudRate_1000=0\n") + node)
    assert loaded.repairs == ()
    file, told, commissioned = loaded.file, loaded.device, loaded.commissioning
    assert (file.name, file.version, file.revision, file.eds_version) == ("sound.eds", "3", "7", "4.0")
    assert (file.description, file.created, file.modified) == ("a drive", "01-02-2003 04:05AM", "06-07-2008")
    assert (told.vendor_name, told.product_name, told.order_code) == ("Maker", "Drive", "D-1")
    assert (told.vendor_number, told.product_number, told.revision_number) == (0x1234, 0x77, 5)
    assert (told.receive_pdos, told.transmit_pdos, told.granularity, told.compact_pdo) == (6, 9, 8, 3)
    assert (told.lss_supported, told.simple_boot_up_slave) == (True, False)
    assert told.bit_rates_kbit_s == ()
    assert commissioned is not None
    assert (commissioned.node_id, commissioned.node_name, commissioned.bit_rate_kbit_s) == (5, "left", 500)
    assert (commissioned.net_number, commissioned.network_name) == (2, "lab")
    assert commissioned.serial_number == 0x99
    for rate in rates:
        one = parse(SOUND.replace("BaudRate_1000=1", f"BaudRate_{rate}=1"))
        assert one.device.bit_rates_kbit_s == (rate,)


def test_dummies_are_the_data_types_that_the_file_marks() -> None:
    """CiA 301 7.4.7: 1 to 7 can be mapped as placeholders."""
    marked = "".join(f"Dummy000{number}={number % 2}\n" for number in range(1, 10))
    start, end = SOUND.index("[DummyUsage]"), SOUND.index("[MandatoryObjects]")
    assert parse(f"{SOUND[:start]}[DummyUsage]\n{marked}{SOUND[end:]}").dummies == (1, 3, 5, 7)
    assert parse(SOUND[:start] + SOUND[end:]).dummies == ()


def test_without_a_node_id_what_needs_it_is_unknown_and_known_to_follow_it() -> None:
    variable = parse(SOUND, None).dictionary.get_variable(0x1800, 1)
    assert variable is not None
    assert (variable.default, variable.relative) == (None, True)


@pytest.mark.parametrize(
    ("old", "new", "telling"),
    [
        ("[1800]\n", "[1000]\nDefaultValue=3\n[1800]\n", "the section occurs twice"),
        ("AccessType=ro", "AccessType=ro\nAccessType=rw", "AccessType occurs twice, as 'ro' and 'rw'"),
        ("ObjectType=0x9", "ObjectType=0x9\nstray words", "no option: 'stray words'"),
        ("ObjectType=0x9", "ObjectType 0x9", "ObjectType has no ="),
        ("ObjectType=0x9", "ObjectType: 0x9", "ObjectType has no ="),
        ("ObjectType=0x9", "ObjectTyp=0x9", "the option is called 'ObjectTyp': read as ObjectType"),
        ("ObjectType=0x9", "Object Type=0x9", "the option is called 'Object Type': read as ObjectType"),
        ("ObjectType=0x9", "ObjectType=RECORD", "ObjectType is 'RECORD': read as 9"),
        ("ObjectType=0x9", "ObjectType=0x19", "ObjectType 25 is unknown: taken for a record"),
        ("ObjectType=0x9\n", "", "ObjectType is missing: taken for a record"),
        ("ObjectType=0x9", "ObjectType=0x7", "a variable with sub-objects"),
        (
            "DataType=0x0007\nAccessType=ro",
            "DataType=\nAccessType=ro",
            "DataType is empty: taken for UNSIGNED32",
        ),
        ("DataType=0x0007\nAccessType=ro", "AccessType=ro", "DataType is missing: taken for UNSIGNED32"),
        (
            "DataType=0x0007\nAccessType=ro",
            "DataType=U32\nAccessType=ro",
            "DataType is 'U32': read as UNSIGNED32",
        ),
        ("DataType=0x0007\nAccessType=ro", "DataType=0x0055\nAccessType=ro", "data type 0055h is unknown"),
        ("DataType=0x0007\nAccessType=ro", "DataType=07h\nAccessType=ro", "a trailing h: read as 7"),
        ("AccessType=ro\nDefaultValue=0x00020192", "DefaultValue=0x00020192", "AccessType is missing"),
        ("AccessType=ro\nDefaultValue=0x0", "AccessType=R/O\nDefaultValue=0x0", "AccessType is 'R/O'"),
        ("ParameterName=Device type\n", "", "ParameterName is missing"),
        ("PDOMapping=0", "PDOMapping=", "PDOMapping is empty"),
        ("PDOMapping=0", "PDOMapping=no", "PDOMapping is 'no'"),
        ("[1800]\nParameterName=TPDO 1\nObjectType=0x9\nSubNumber=2\n", "", "but not the object"),
        ("BaudRate_1000=1", "BaudRate_1000=perhaps", "BaudRate_1000 is 'perhaps', no number"),
        ("SubNumber=2", "SubNumber=two", "SubNumber is 'two', no number"),
        ("SubNumber=2", "SubNumber=7", "SubNumber is 7, 2 sub-objects are there"),
        ("SupportedObjects=2", "SupportedObjects=9", "SupportedObjects is 9, 2 are listed"),
        ("2=0x1800", "2=0x1018", "object 1018h is listed, but not defined"),
        ("2=0x1800", "2=1800", None),
        ("2=0x1800", "2=0x1000", "object 1000h is listed twice"),
        ("1=0x2000", "1=nothing", "entry 1 is 'nothing', no index"),
        ("1=0x2000\n", "", "the object is defined, but in no list"),
        ("[1800]", "[0x1800]", "the section is called '0x1800'"),
        ("[1800sub1]", "[1800 Sub 1]", "the section is called '1800 Sub 1'"),
        ("[1800sub1]", "[1800.1]", "the section is called '1800.1'"),
        ("[1800sub1]", "[1800sub1", "no closing bracket|the line is '[1800sub1'"),
        ("[1800sub1]", "[1800sub1] odds", "the line is '[1800sub1] odds'"),
        ("DefaultValue=1\n", "DefaultValue=300\n", "left out, for UNSIGNED8 does not hold it"),
        ("DefaultValue=1\n", "DefaultValue=one\n", "DefaultValue is 'one': left out, for it is no number"),
        ("[DeviceInfo]\nVendorNumber=0x1234\nBaudRate_1000=1\n", "", "[DeviceInfo] the section is missing"),
        ("HighLimit=0x7FFFFFFF", "HighLimit=0x90000000", None),
        ("LowLimit=0x80000000", "LowLimit=0x7FFFFFFF\nHighLimit=5", "is above HighLimit 5: both left out"),
        ("LowLimit=0x80000000\nHighLimit=0x7FFFFFFF", "LowLimit=0\nHighLimit=0", "both limits are 0"),
        ("LowLimit=0x80000000", "LowLimit=-5", "beyond the limits -5 to 2147483647: kept"),
    ],
)
def test_each_fault_is_mended_and_told(old: str, new: str, telling: str | None) -> None:
    assert old in SOUND
    loaded = parse(SOUND.replace(old, new, 1))
    if telling is None:
        assert loaded.repairs == ()
    else:
        assert any(words in repairs(loaded) for words in telling.split("|"))
    assert value(loaded, 0x1000) == 0x20192
    assert value(loaded, 0x1800, 1) == 0x185
    assert loaded.dictionary.get_variable(0x607D, 2) is not None


def test_a_repair_names_section_and_line() -> None:
    text = SOUND.replace("DefaultValue=1000", "DefaultValue=1O00")
    (repair,) = parse(text).repairs
    assert (repair.section, repair.line) == ("607Dsub2", line_of(text, "DefaultValue=1O00"))
    assert str(repair).startswith(f"line {repair.line} [607Dsub2] DefaultValue is '1O00'")


def test_no_lists_at_all_are_one_repair() -> None:
    start, end = SOUND.index("[MandatoryObjects]"), SOUND.index("[1000]")
    (repair,) = parse(SOUND[:start] + SOUND[end:]).repairs
    assert repair.fault == "the lists of objects are missing"


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ("192h", 0x192),
        ("0X192", 0x192),
        ("00402", 402),
        ("0089", 89),
        ("2019A", 0x2019A),
        ("1 000", 1000),
        ('"402"', 402),
        ("402U", 402),
        ("402.0", 402),
        ("16#192", 0x192),
        ("+402", 402),
        ("402;comment", 402),
        ("402 ; comment", 402),
        ("=402", 402),
        ("00020192", 0x20192),
    ],
)
def test_numbers_in_every_spelling(written: str, read: int) -> None:
    assert value(parse(SOUND.replace("0x00020192", written)), 0x1000) == read


@pytest.mark.parametrize(
    "written",
    [
        "0x180+$NODEID",
        "$NodeID + 180h",
        "$NODEID+384",
        "0x180 + $NODEID",
        "$NODE_ID+0x180",
        "180h+$nodeid",
        "$NODEID+180",
        "$nodeid+0X180",
        "($NODEID)+0x180",
        "$(NODEID)+0x180",
        "NODEID+0x180",
        "1*$NODEID+0x180",
        "$NODEID+0x100+0x80",
        "0x100|0x80+$NODEID",
        "$NODEID + 3 * 0x80",
        '"$NODEID+0x180"',
        "0x180$NODEID",
        "$NODEID+0x180 ; COB-ID",
    ],
)
def test_node_id_in_every_spelling(written: str) -> None:
    loaded = parse(SOUND.replace("$NODEID+0x180", written))
    assert value(loaded, 0x1800, 1) == 0x185
    assert loaded.dictionary.get_variable(0x1800, 1).relative  # type: ignore[union-attr]


def test_a_formula_that_is_none_is_left_out() -> None:
    loaded = parse(SOUND.replace("$NODEID+0x180", "$NODEID+/7"))
    assert value(loaded, 0x1800, 1) is None
    assert "no formula of $NODEID" in repairs(loaded)


def test_a_multiple_of_the_node_id_does_not_follow_by_addition() -> None:
    loaded = parse(SOUND.replace("$NODEID+0x180", "$NODEID*2+0x180"))
    variable = loaded.dictionary.get_variable(0x1800, 1)
    assert variable is not None
    assert (variable.default, variable.relative) == (0x18A, False)


def test_cob_ids_and_mappings_in_digits_alone() -> None:
    text = SOUND.replace("$NODEID+0x180", "80000181")
    text += "[1A00]\nParameterName=M\nObjectType=9\nSubNumber=2\n"
    text += "[1A00sub0]\nParameterName=n\nDataType=5\nAccessType=rw\nDefaultValue=1\n"
    text += "[1A00sub1]\nParameterName=m\nDataType=7\nAccessType=rw\nDefaultValue=60410010\n"
    loaded = parse(text)
    assert value(loaded, 0x1800, 1) == 0x80000181
    assert value(loaded, 0x1A00, 1) == 0x60410010


def test_comments_and_lower_case_are_no_faults() -> None:
    text = SOUND.replace("[1800sub1]", "; a comment\n# another\n[1800SUB01] ; a third").replace(
        "AccessType", "accesstype"
    )
    text += "[Comments]\nLines=7\nLine1=x; y ; z\n"
    text = text.replace("SubNumber=2", "SubNumber=2 ; of them\nCompactSubObj=0")
    loaded = parse(text)
    assert loaded.repairs == ()
    assert value(loaded, 0x1800, 1) == 0x185


def test_a_text_may_hold_a_semicolon() -> None:
    loaded = parse(SOUND.replace("DefaultValue=a = b", "DefaultValue=A;B ; a comment"))
    assert value(loaded, 0x2000) == "A;B"
    loaded = parse(SOUND.replace("AccessType=ro", "AccessType=ro;"))
    assert loaded.repairs == ()


def test_a_name_may_hold_a_semicolon() -> None:
    loaded = parse(SOUND.replace("Device type", "Device;type ; a comment"))
    assert loaded.dictionary[0x1000].name == "Device;type"


def test_trailing_garbage_is_left_out() -> None:
    loaded = parse(SOUND.encode() + b"\r\n\x1a\0\0\0\r\n%%EOF garbage")
    assert "no option: '%%EOF garbage'" in repairs(loaded)
    assert value(loaded, 0x1800, 1) == 0x185


def test_signed_values_as_bits_and_as_decimals() -> None:
    hexadecimal = parse(SOUND.replace("DefaultValue=1000", "DefaultValue=0xFFFFFFFF"))
    assert (value(hexadecimal, 0x607D, 2), hexadecimal.repairs) == (-1, ())
    decimal = parse(SOUND.replace("DefaultValue=1000", "DefaultValue=4294967295"))
    assert value(decimal, 0x607D, 2) == -1
    assert "beyond its signed type: read as -1" in repairs(decimal)
    negative = parse(SOUND.replace("0x00020192", "-1"))
    assert value(negative, 0x1000) == 0xFFFFFFFF
    assert "negative in an unsigned type" in repairs(negative)


@pytest.mark.parametrize(
    "data", [b"", b"\0" * 100, b"[FileInfo]\nFileName=x\n", b"not an EDS", b"[1000]\n\n"[:2]]
)
def test_what_is_no_dictionary_is_bad_input(data: bytes) -> None:
    with pytest.raises(BadInput, match=r"test\.eds: found .*expected an EDS or DCF"):
        parse_dictionary(data, "test.eds")


@pytest.mark.parametrize(
    ("data", "found"),
    [(b"\xef\xbb\xbf<?xml version='1.0'?><a/>", "a root element 'a'"), (b"PK\x03\x04xxxx", "an archive")],
)
def test_other_formats_are_named(data: bytes, found: str) -> None:
    with pytest.raises(BadInput, match=found):
        parse_dictionary(data, "test.eds")


def test_a_missing_file_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="not found"):
        load_dictionary(tmp_path / "none.eds")
    with pytest.raises(BadInput, match="a folder"):
        load_dictionary(tmp_path)


@examples_of(300)
@given(st.integers(0, len(SOUND) - 1), st.integers(0, 60), st.binary(max_size=6))
def test_no_damage_is_anything_but_repairs_or_bad_input(start: int, length: int, patch: bytes) -> None:
    data = SOUND.encode()
    damaged = data[:start] + patch + data[start + length :]
    try:
        loaded = parse(damaged)
    except BadInput:
        return
    assert isinstance(loaded, LoadedDictionary)


@examples_of(200)
@given(st.text(alphabet="$NODEIDnodeid+-*|()0x18Fh ;", max_size=24))
def test_no_formula_is_anything_but_a_value_or_a_repair(text: str) -> None:
    loaded = parse(SOUND.replace("$NODEID+0x180", text))
    found = value(loaded, 0x1800, 1)
    assert found is None or isinstance(found, int)
