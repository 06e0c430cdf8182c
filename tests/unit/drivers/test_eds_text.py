"""Code pages, byte order marks and line ends of data sheets."""

import pytest

from servobench.drivers.sheets.eds.text import Repair, RepairLog, lines_of


def read(data: bytes) -> tuple[list[str], tuple[Repair, ...]]:
    log = RepairLog()
    return lines_of(data, log), log.in_order_of_lines()


@pytest.mark.parametrize(
    ("text", "codec", "named"),
    [
        ("ParameterName=Gerätetyp, Größe, Überlauf", "cp1252", "Windows code page 1252"),
        ("Line3=71101 Schönaich", "cp850", "DOS code page 850"),
        ("Line3=Größe der Übersetzung für Räder", "cp850", "DOS code page 850"),
        ("Unit=50 µm, 90°, ±5 %, s²", "cp1252", "Windows code page 1252"),
        ("VendorName=Société générale à Besançon", "cp1252", "Windows code page 1252"),
        ("VendorName=Soci\u00e9t\u00e9 fran\u00e7aise", "cp850", "DOS code page 850"),
        ("Name=“quoted” \u2013 and the drive\u2019s own …", "cp1252", "Windows code page 1252"),
        ("ParameterName=位置实际值", "gb18030", "GB 18030"),
        ("ParameterName=Ma\u00df und H\u00f6he", "latin-1", "Windows code page 1252"),
        ("Name=\x81\x8d h\u00f6her", "latin-1", "Latin-1|DOS code page 850"),
    ],
)
def test_the_code_page_is_told_by_the_text(text: str, codec: str, named: str) -> None:
    lines, repairs = read(b"[FileInfo]\r\n" + text.encode(codec) + b"\r\n")
    assert any(f"read as {name}" in str(repairs[0]) for name in named.split("|"))
    assert repairs[0].line == 2
    if "|" not in named:
        assert lines[1] == text


def test_utf_8_needs_no_repair() -> None:
    assert read("ParameterName=Größe 位置 µ".encode()) == (["ParameterName=Größe 位置 µ"], ())


def test_utf_8_and_a_code_page_in_one_file() -> None:
    lines, repairs = read("a=Größe\n".encode() + "b=Höhe\n".encode("cp1252"))
    assert lines[:2] == ["a=Größe", "b=Höhe"]
    assert len(repairs) == 1


@pytest.mark.parametrize("codec", ["utf-8-sig", "utf-16", "utf-32"])
def test_byte_order_marks(codec: str) -> None:
    lines, repairs = read("[FileInfo]\nx=ö\n".encode(codec))
    assert lines[:2] == ["[FileInfo]", "x=ö"]
    assert "byte order mark" in repairs[0].fault


@pytest.mark.parametrize("codec", ["utf-16-le", "utf-16-be"])
def test_wide_characters_without_a_mark(codec: str) -> None:
    lines, repairs = read("[FileInfo]\nFileName=wide.eds\n".encode(codec))
    assert lines[:2] == ["[FileInfo]", "FileName=wide.eds"]
    assert repairs[0].fault == "every other octet is 0"


@pytest.mark.parametrize(("end", "told"), [("\n", False), ("\r\n", False), ("\r", True), ("\r\r\n", True)])
def test_line_ends(end: str, told: bool) -> None:
    lines, repairs = read(end.join(["[1000]", "a=1", "b=2"]).encode())
    assert lines == ["[1000]", "a=1", "b=2"]
    assert bool(repairs) == told


def test_no_octets_are_too_odd() -> None:
    lines, _ = read(bytes(range(256)) * 2)
    assert "".join(lines)
