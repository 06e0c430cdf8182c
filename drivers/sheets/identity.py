"""Identifies the device of a data sheet: by 1018h, else by [DeviceInfo] (CiA 306-1)."""

from typing import NamedTuple

import canopen.objectdictionary as od

from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.sheets.dictionary import held_number

_PARTS = ("vendor", "product", "revision")


class ToldIdentity(NamedTuple):
    """The numbers in a sheet for each part of an identity, 1018h's first; 0 is none. With two the sheet
    contradicts itself, and a device may have either."""

    vendor: tuple[int, ...]
    product: tuple[int, ...]
    revision: tuple[int, ...]

    def strangers(self, vendor: int, product: int, revision: int) -> list[tuple[str, int, int]]:
        """Return part, the sheet's number and the device's number wherever they differ; an unknown number on
        either side does not differ."""
        held = (vendor, product, revision)
        return [
            (part, told[0], number)
            for part, told, number in zip(_PARTS, self, held, strict=True)
            if told and number and number not in told
        ]


def told_identity(dictionary: od.ObjectDictionary) -> ToldIdentity:
    """Return the identity in the sheet of a dictionary."""
    information = dictionary.device_information
    return ToldIdentity(
        _numbers(dictionary, 1, information.vendor_number),
        _numbers(dictionary, 2, information.product_number),
        _numbers(dictionary, 3, information.revision_number),
    )


def _numbers(dictionary: od.ObjectDictionary, sub: int, informed: int | None) -> tuple[int, ...]:
    numbers = (held_number(dictionary, Cia301.IDENTITY, sub), informed)
    return tuple(dict.fromkeys(number & 0xFFFF_FFFF for number in numbers if number))
