"""Which device a data sheet is of."""

import pytest

from servobench.drivers.sheets.dictionary import told_identity
from tests.unit.drivers.eds_maker import U8, U32, sheet, sub


def identity_object(vendor: str, product: str, revision: str = "") -> str:
    head = "[1018]\nParameterName=Identity\nObjectType=9\nSubNumber=4\n" + sub(0x1018, 0, U8, "ro", "3")
    values = enumerate((vendor, product, revision), start=1)
    return head + "".join(sub(0x1018, number, U32, "ro", value) for number, value in values)


@pytest.mark.parametrize(
    ("also", "vendor", "product"),
    [
        ("", (0x123,), ()),
        (identity_object("", ""), (0x123,), ()),
        (identity_object("0", "0x77"), (0x123,), (0x77,)),
        (identity_object("0x123", "0x77"), (0x123,), (0x77,)),
        (identity_object("0x124", "0x77"), (0x124, 0x123), (0x77,)),
    ],
    ids=["no 1018h", "no defaults", "a zero", "both the same", "two vendors"],
)
def test_1018h_goes_before_device_info(also: str, vendor: tuple[int, ...], product: tuple[int, ...]) -> None:
    told = told_identity(sheet([], also=also).dictionary)
    assert (told.vendor, told.product, told.revision) == (vendor, product, ())


@pytest.mark.parametrize(
    ("held", "strangers"),
    [
        ((0x124, 0x77, 5), []),
        ((0x123, 0x77, 5), []),
        ((0, 0, 0), []),
        ((0x125, 0x77, 0), [("vendor", 0x124, 0x125)]),
        ((0x124, 0x78, 0), [("product", 0x77, 0x78)]),
    ],
)
def test_a_device_may_have_either_of_two_numbers(
    held: tuple[int, int, int], strangers: list[tuple[str, int, int]]
) -> None:
    told = told_identity(sheet([], also=identity_object("0x124", "0x77")).dictionary)
    assert told.strangers(*held) == strangers
