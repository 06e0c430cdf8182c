"""Which drive a data sheet is for."""

import pytest

from drivers.drive_setup import Identity
from hil.drive_settings import identity_notes
from tests.unit.drivers.eds_maker import NODE, four_pdos, sheet

MADE = Identity("made", 0x123, 7, 0, 0, 0x20192)


@pytest.mark.parametrize(
    ("vendor", "notes"),
    [
        (0x123, []),
        (0, []),
        (0x99, ["the data sheet is for vendor 00000123h, the drive is 00000099h"]),
    ],
)
def test_another_drive_than_the_sheets_is_told(vendor: int, notes: list[str]) -> None:
    assert identity_notes(MADE._replace(vendor=vendor), sheet(four_pdos()), NODE) == notes
