"""Data types of objects of the standards, by the tables of CiA 301 (7.5.2) and CiA 402-2."""

import pytest

from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.sheets.eds import types
from servobench.drivers.sheets.eds.types import standard_object_type, standard_type

I8, I32 = DataType.INTEGER8, DataType.INTEGER32
U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
PDO_COMMUNICATION = {0: U8, 1: U32, 2: U8, 3: U16, 4: U8, 5: U16, 6: U8}
PDO_MAPPING = {0: U8, 1: U32, 2: U32, 64: U32}


@pytest.mark.parametrize("index", [0x1400, 0x1401, 0x15FF, 0x1800, 0x1803, 0x19FF])
def test_pdo_communication_parameters(index: int) -> None:
    assert {sub: standard_type(index, sub) for sub in PDO_COMMUNICATION} == PDO_COMMUNICATION
    assert standard_type(index, 7) is None
    assert standard_object_type(index) == types.RECORD


@pytest.mark.parametrize("index", [0x1600, 0x17FF, 0x1A00, 0x1BFF])
def test_pdo_mapping_parameters(index: int) -> None:
    assert {sub: standard_type(index, sub) for sub in PDO_MAPPING} == PDO_MAPPING
    assert standard_object_type(index) == types.RECORD


@pytest.mark.parametrize(
    ("index", "sub", "expected"),
    [
        (0x1000, None, U32), (0x1001, None, U8), (0x1005, None, U32), (0x100C, None, U16), (0x100D, None, U8),
        (0x1014, None, U32), (0x1015, None, U16), (0x1017, None, U16), (0x1019, None, U8),
        (0x1008, None, DataType.VISIBLE_STRING), (0x6040, None, U16), (0x6041, None, U16), (0x6060, None, I8),
        (0x6064, None, I32), (0x606C, None, I32), (0x6071, None, DataType.INTEGER16),
        (0x6075, None, U32), (0x6077, None, DataType.INTEGER16), (0x607A, None, I32), (0x6098, None, I8),
        (0x60FF, None, I32), (0x6502, None, U32),
        (0x1003, 0, U8), (0x1003, 1, U32), (0x1010, 1, U32), (0x1011, 1, U32), (0x1016, 1, U32),
        (0x1018, 1, U32), (0x1018, 4, U32), (0x1029, 1, U8), (0x607D, 0, U8), (0x607D, 1, I32),
        (0x608F, 1, U32), (0x6091, 2, U32), (0x6099, 1, U32), (0x60C2, 1, U8), (0x60C2, 2, I8),
    ],
)  # fmt: skip
def test_objects_of_device_and_drive(index: int, sub: int | None, expected: DataType) -> None:
    assert standard_type(index, sub) == expected


@pytest.mark.parametrize("index", [0x1399, 0x13FF, 0x1C00, 0x2000, 0x5FFF, 0x6FFF, 0x9000])
def test_of_others_the_standards_say_nothing(index: int) -> None:
    assert standard_type(index, None) is standard_type(index, 1) is standard_object_type(index) is None


def test_kinds_of_objects() -> None:
    kinds = {0x6040: types.VARIABLE, 0x1018: types.RECORD, 0x60C2: types.RECORD, 0x1003: types.ARRAY}
    kinds |= {0x607D: types.ARRAY, 0x1021: types.DOMAIN_OBJECT}
    assert {index: standard_object_type(index) for index in kinds} == kinds
