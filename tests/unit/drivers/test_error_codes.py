"""Error codes in words, the standard's and the vendors'."""

import pytest

from servobench.drivers.canopen.error_codes import (
    ERROR_TEXTS,
    error_text,
    fault_text,
    history_text,
    register_text,
)
from servobench.drivers.canopen.nmt import Emergency
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.drivers.vendors.families import known_families, read_family

MAXON = 0xFB


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x2320, "short circuit or earth leakage"),
        (0x2333, "earth leakage, phase W"),
        (0x3132, "mains phase L2 missing"),
        (0x7305, "incremental sensor 1"),
        (0x630C, "data record no. 12"),
        (0x8611, "following error"),
        (0x8FFF, "monitoring"),
        (0xFF42, "manufacturer-specific"),
        (0x10FF, "generic error"),
    ],
)
def test_standard_texts(code: int, text: str) -> None:
    assert error_text(code) == text


def test_every_code_has_a_class() -> None:
    for code in ERROR_TEXTS:
        assert error_text(code) == ERROR_TEXTS[code]
        assert code < 0x1000 or error_text(code | 0xF) != "unknown error class"


@pytest.mark.parametrize(
    ("register", "text"),
    [(0x00, "none"), (0x01, "generic"), (0x07, "generic, current, voltage"), (0x81, "generic, manufacturer")],
)
def test_error_register(register: int, text: str) -> None:
    assert register_text(register) == text


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x7392, "main sensor counts the wrong way; sensor"),
        (0x6185, "internal software error; internal software"),
        (0x8A88, "STO active; control"),
        (0x2310, "over-current"),
        (0x3110, "mains over-voltage"),
    ],
)
def test_a_vendors_words_go_first(code: int, text: str) -> None:
    assert fault_text(code, MAXON, "EPOS4") == text
    assert fault_text(code, 0, "EPOS4") == error_text(code)
    assert fault_text(code, MAXON, "EPOS2") == error_text(code)


def test_every_code_of_a_maker_has_a_source() -> None:
    families = [family for family in known_families() if family.texts or family.numbers]
    assert len(families) >= 3
    vague = [family.name for family in families if len(family.source) <= 40]
    assert not vague, f"{vague}: source has to name document, edition and table"


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("source = 'x'\n[codes]\n7380 = 'a'", "vendor"),
        ("vendor = 1\n[codes]\n7380 = 'a'", "source"),
        ("vendor = 1\nsource = 'x'\n[codes]\nxyz = 'a'", "codes.xyz"),
    ],
)
def test_bad_tables_are_named(text: str, key: str) -> None:
    with pytest.raises(BadInput) as caught:
        read_family(text, "bad.toml")
    assert caught.value.key == key


def test_an_emergency_in_its_makers_words() -> None:
    emergency = Emergency(3, 0x8A80, 0x80, b"\1\0\0\0\0", Instant(0))
    assert emergency.told(MAXON, "EPOS4") == (
        "EMCY 8A80h (negative limit switch; control), register 80h (manufacturer), manufacturer 0100000000"
    )
    assert str(emergency).startswith("EMCY 8A80h (control), register 80h")


def test_an_entry_of_the_history_with_its_makers_cause() -> None:
    assert history_text(0x0D008611, 0x26C) == "following error"
    assert history_text(0x0F007121, 0x26C) == "motor blocked"
    assert history_text(0x07007305, 0x26C) == "incremental sensor 1 (encoder: electrical fault or defect)"
    assert history_text(0x07007305) == "incremental sensor 1"
    assert history_text(0, 0x26C) == "no error"
