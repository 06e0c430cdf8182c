"""Error codes of EMCY and of 0x603F in words: CiA 301 table 26, CiA 402-1 (error codes), makers' tables."""

import tomllib
from enum import IntFlag
from importlib.resources import files
from typing import Final

from servobench.drivers.vendors.families import codes_of

_TABLES = tomllib.loads(files(__package__).joinpath("error_codes.toml").read_text("utf-8"))
ERROR_TEXTS: dict[int, str] = {int(code, 16): text for code, text in _TABLES["codes"].items()}
"""Error codes of 0x603F and of EMCY, CiA 402-1 (error codes) and CiA 301 table 26."""
NO_ERROR: Final = 0x0000
"""The EMCY that says that all errors are gone (CiA 301 7.2.7.1)."""
HEARTBEAT_ERROR: Final = 0x8130
"""Life guarding or a heartbeat failed (CiA 301, table 26)."""


class ErrorRegister(IntFlag):
    """Bits of object 1001h (CiA 301, 7.5.2.2)."""

    GENERIC = 0x01
    CURRENT = 0x02
    VOLTAGE = 0x04
    TEMPERATURE = 0x08
    COMMUNICATION = 0x10
    DEVICE_PROFILE = 0x20
    RESERVED = 0x40
    MANUFACTURER = 0x80


def error_text(code: int) -> str:
    """Return the text of an error code, or of the narrowest class that holds it: 0x83FF is "torque
    control"."""
    for digits in (0xFFFF, 0xFFF0, 0xFF00, 0xF000):
        text = ERROR_TEXTS.get(code & digits)
        if text is not None and (code & digits or not code):
            return text
    return "unknown error class"


def register_text(register: int) -> str:
    """Name the kinds of errors in 0x1001: "current, voltage"; "none"."""
    kinds = [str(bit.name).lower().replace("_", " ") for bit in ErrorRegister if register & bit]
    return ", ".join(kinds) or "none"


# ---- vendors ----------------------------------------------------------------------------------------------


def fault_text(code: int, vendor: int = 0, device_name: str = "") -> str:
    """Return the vendor's text with the standard's class, or the standard's text alone."""
    standard = error_text(code)
    for table in codes_of(vendor, device_name):
        own = table.text(code)
        if own is not None:
            return own if own == standard or code in ERROR_TEXTS else f"{own}; {standard}"
    return standard


def history_text(entry: int, vendor: int = 0, device_name: str = "") -> str:
    """Describe an entry of 0x1003: the code in its low half, the maker's information in its high half."""
    text = fault_text(entry & 0xFFFF, vendor, device_name)
    for table in codes_of(vendor, device_name):
        cause = table.numbers.get(entry >> 24)
        if cause is not None and entry & 0xFFFF:
            return text if cause == text else f"{text} ({cause})"
    return text
