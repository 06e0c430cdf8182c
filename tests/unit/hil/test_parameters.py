"""Values of every data type into a DCF and back: the bytes are the same."""

import random
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from canopen.objectdictionary import ObjectDictionary, ODVariable

from servobench.drivers.canopen.objects301 import BITS, REAL_BITS, DataType
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.sheets.dictionary import is_kept, value_text
from servobench.hil.inspecting.parameters import (
    ParameterSet,
    configuration_text,
    differences,
    parameters_in,
    parameters_of,
)
from tests.rehearsals.rehearsal import made_sheet

IDENTITY = Identity("a drive", 0xA11, 0xB22, 3, 4, 0x20192)
KINDS = [kind for kind in DataType if kind is not DataType.DOMAIN]
LETTERS = "abcXYZ 0123456789%$#=[]"


def drawn(kind: DataType, draw: random.Random) -> bytes:
    if kind in (DataType.VISIBLE_STRING, DataType.UNICODE_STRING):
        text = "".join(draw.choices(LETTERS, k=draw.randrange(12))).strip()
        return text.encode("utf_16_le" if kind is DataType.UNICODE_STRING else "ascii")
    if kind is DataType.BOOLEAN:
        return bytes([draw.randrange(2)])
    if kind in REAL_BITS:
        value = draw.choice([0.0, -1.5, 1e-30, draw.uniform(-1e6, 1e6)])
        return struct.pack("<f" if REAL_BITS[kind] == 32 else "<d", value)
    length = BITS[kind] // 8 if kind in BITS else draw.randrange(1, 9)
    return draw.choice([bytes(length), b"\xff" * length, draw.randbytes(length)])


def dictionary_of(count: int) -> Any:
    """So many variables of each kind, from 2000h on."""
    dictionary: Any = ObjectDictionary()  # type: ignore[no-untyped-call]
    dictionary.node_id = 1
    for number, kind in enumerate(kind for kind in KINDS for _ in range(count)):
        variable = ODVariable(f"variable {number}", 0x2000 + number, 0)
        variable.data_type, variable.access_type = kind, "rw"
        dictionary.add_object(variable)
    return dictionary


def held(values: dict[tuple[int, int], bytes], source: str = "a drive") -> ParameterSet:
    kinds = {place: KINDS[(place[0] - 0x2000) // 8] for place in values}
    device = frozenset((IDENTITY.vendor,)), frozenset((IDENTITY.product,))
    names = dict.fromkeys(values, "a name")
    return ParameterSet(source, device, values, names, kinds, {})


def worlds(seed: int) -> Iterator[dict[tuple[int, int], bytes]]:
    draw = random.Random(seed)
    for _ in range(10):
        yield {(0x2000 + number, 0): drawn(KINDS[number // 8], draw) for number in range(8 * len(KINDS))}


@pytest.mark.parametrize("seed", range(3))
def test_each_value_comes_back_bit_for_bit(seed: int, tmp_path: Path) -> None:
    for values in worlds(seed):
        path = tmp_path / "drive.dcf"
        path.write_text(configuration_text(held(values), dictionary_of(8), IDENTITY, 500_000))
        again = parameters_of(path)
        assert {place: (value, again.values.get(place)) for place, value in values.items()
                if again.values.get(place, b"") != value} == {}  # fmt: skip
        assert differences(held(values), again) == []
        assert again.device == (frozenset((0xA11,)), frozenset((0xB22,)))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_text_is_kept_if_a_line_of_the_file_gives_it_back(seed: int, tmp_path: Path) -> None:
    draw, path = random.Random(seed), tmp_path / "drive.dcf"
    place = (0x2000 + 8 * KINDS.index(DataType.VISIBLE_STRING), 0)
    kept = set()
    for text in [
        "plain",
        " x",
        "x;y",
        "x ",
        "\tx",
        *("".join(draw.choices("ab ;\t=[", k=3)) for _ in range(40)),
    ]:
        value = text.encode()
        whole = {place: value, (0x2000, 0): b"\1"}
        path.write_text(configuration_text(held(whole), dictionary_of(8), IDENTITY, 500_000))
        assert is_kept(value, DataType.VISIBLE_STRING) <= (parameters_of(path).values.get(place) == value), (
            text
        )
        kept.add(is_kept(value, DataType.VISIBLE_STRING))
    assert kept == {True, False}
    assert is_kept(b";", DataType.OCTET_STRING)


def test_numbers_are_written_as_cia_306_has_them() -> None:
    assert value_text(b"\xfe\xff", DataType.INTEGER16) == "-2"
    assert value_text(b"\xfe\xff", DataType.UNSIGNED16) == "0xFFFE"
    assert value_text(struct.pack("<f", 0.1), DataType.REAL32) == "0.10000000149011612"
    assert value_text(b"abc\0", DataType.VISIBLE_STRING) == "abc"
    assert value_text(b"\x01\xab", DataType.OCTET_STRING) == "01AB"


def test_what_starts_a_program_and_what_holds_one_is_no_parameter() -> None:
    """CiA 302-3: 1F50h program data to 1F59h, 1F20h to 1F23h configurations; 1F5Ah on is nothing of it."""
    dictionary = dictionary_of(0)
    for index in (0x1F1F, 0x1F20, 0x1F23, 0x1F24, 0x1F4F, 0x1F50, 0x1F51, 0x1F57, 0x1F59, 0x1F5A):
        variable = ODVariable("any", index, 0)
        variable.data_type, variable.access_type = DataType.UNSIGNED8, "rw"
        dictionary.add_object(variable)
    found = [each.index for each in parameters_in(dictionary)]
    assert found == [0x1F1F, 0x1F24, 0x1F4F, 0x1F5A]


def test_what_only_one_of_two_has_differs() -> None:
    first, second = {(0x2000, 0): b"\1", (0x2001, 0): b"\0"}, {(0x2001, 0): b"\1", (0x2002, 0): b"\1"}
    found = differences(held(first), held(second, "another"))
    assert [(each.place[0], each.first, each.second) for each in found] == [
        (0x2000, "0x1", ""),
        (0x2001, "0x0", "0x1"),
        (0x2002, "", "0x1"),
    ]


def test_files_are_compared_in_their_own_units(tmp_path: Path) -> None:
    text = made_sheet(["2100h:01 a serial number"], tmp_path).read_text()
    text = text.replace("AccessType=ro\nPDOMapping=0\nDefaultValue=305419896", "AccessType=rw\nPDOMapping=0")
    values = {"2100sub0": (1, 2), "2100sub1": (3, 7), "6072": (500, 1000), "60C5": (1, 2)}
    files = []
    for number in range(2):
        told = text
        for section in ("2100sub0", "2100sub1"):
            told = told.replace(f"[{section}]\n", f"[{section}]\nUnit=degC\nFactor=0.5\n")
        for section, pair in values.items():
            told = told.replace(f"[{section}]\n", f"[{section}]\nParameterValue={pair[number]}\n")
        files.append(tmp_path / f"{number}.dcf")
        files[-1].write_text(told)
    found = {each.place: each[4:] for each in differences(*map(parameters_of, files))}
    rated_nm = 0.001 * int(text.partition("[6076]")[2].partition("DefaultValue=")[2].split()[0])
    assert found[0x2100, 1] == ("1.5 degC", "3.5 degC")
    assert found[0x6072, 0] == (f"{0.5 * rated_nm:.6g} N m", f"{rated_nm:.6g} N m")
    assert found[0x60C5, 0][1].endswith(" rad/s^2")
    assert found[0x2100, 0] == ("", ""), "a count"
