"""No file that a user names can stop a loader, keep it busy, or reach a terminal as it is."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from servobench.drivers.bounded_file import (
    INTEGER_MAX,
    SIZE_MAX_BYTES,
    WORD_MAX,
    NamedBy,
    NoSuchFile,
    parse_json,
    parse_toml,
    read_bytes,
    read_lines,
    read_text,
    read_toml,
)
from servobench.drivers.errors import BadInput, printable
from servobench.drivers.sheets.dictionary import load_dictionary, parse_dictionary
from servobench.drivers.written_file import write_file, writing
from tests.mutants.mutant import PROCESSOR_S_MAX, processor_s

SHEET = b"[1000]\nParameterName=Device type\nObjectType=7\nDataType=7\nAccessType=ro\nDefaultValue=%s\n"
READERS: list[Callable[[Path], object]] = [
    lambda path: read_bytes(path, "thing"),
    lambda path: read_toml(path, "thing"),
    lambda path: list(read_lines(path, "thing")),
    load_dictionary,
]


@pytest.mark.parametrize("read", READERS)
def test_only_regular_files_are_read(tmp_path: Path, read: Callable[[Path], object]) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path, found in (
        (tmp_path / "fifo", "a FIFO"),
        (Path("/dev/zero"), "a character device"),
        (tmp_path, "a folder"),
    ):
        with pytest.raises(BadInput, match="a regular file") as caught:
            read(path)
        assert caught.value.value == found


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("name", ["none.toml", "x" * 300, "a\0b", "none/none.toml"])
def test_a_name_without_a_file_is_bad_input(
    tmp_path: Path, read: Callable[[Path], object], name: str
) -> None:
    with pytest.raises(BadInput):
        read(tmp_path / name)


def test_who_names_a_missing_file_is_blamed(tmp_path: Path) -> None:
    (tmp_path / "motor.toml").touch()
    with pytest.raises(NoSuchFile, match=r"motor\.toml\?") as caught:
        read_toml(tmp_path / "moter.toml", "motor file", NamedBy("bench.toml", "drive.a.motor", "moter.toml"))
    assert (caught.value.source, caught.value.key) == ("bench.toml", "drive.a.motor")


def test_a_missing_file_is_named_with_its_kind_and_who_names_it(tmp_path: Path) -> None:
    missing = tmp_path / "none" / "bench.toml"
    with pytest.raises(BadInput) as caught:
        read_text(missing, "bench file")
    assert str(caught.value) == f"Bench file not found: {missing}; there is no folder {missing.parent}"
    with pytest.raises(BadInput) as caught:
        read_text(missing, "EDS or DCF file", NamedBy("bench.toml", "drive.a.eds", "none/x.eds"))
    assert str(caught.value).startswith("bench.toml: drive.a.eds: EDS or DCF file not found: none/x.eds;")


def test_size_length_and_encoding_are_bounded(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"#" * SIZE_MAX_BYTES)
    assert len(read_text(path, "thing")) == SIZE_MAX_BYTES
    path.write_bytes(b"#" * (SIZE_MAX_BYTES + 1))
    with pytest.raises(BadInput, match="at most"):
        read_text(path, "thing")
    with pytest.raises(BadInput, match="a longer line"):
        list(read_lines(path, "thing", size_max_bytes=2 * SIZE_MAX_BYTES))
    os.truncate(path, 3 * SIZE_MAX_BYTES)
    for refuse in (read_text, read_bytes, lambda path, what: list(read_lines(path, what))):
        with pytest.raises(BadInput) as caught:
            refuse(path, "thing")
        assert caught.value.value == f"{3 * SIZE_MAX_BYTES} bytes", "before it is read"
    path.write_bytes(b"a = 1\n\xff")
    for read in (read_toml, lambda path, what: list(read_lines(path, what))):
        with pytest.raises(BadInput, match="UTF-8"):
            read(path, "thing")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a = " + "[" * 3000, "at most 32"),
        ("a = " + "[" * 3000 + "]" * 3000, "at most 32"),
        ("a = " + "{b = " * 3000, "at most 32"),
        ("a." * 50_000 + "b = 1", "at most 32"),
        ('"a". ' * 50_000 + "b = 1", "at most 32"),
        ("[" + "a." * 50_000 + "b]", "at most 32"),
        ("a = " + "9" * 4301, "at most 256 characters"),
        ("a = 1." + "9" * 100_000, "at most 256 characters"),
        ("k" * 100_000 + " = 1", "at most 256 characters"),
        ('"' + "k" * 100_000 + '" = 1', "at most 256"),
        ("a = 1" + "0" * 250, "at most 64 bits"),
        (f"a = {INTEGER_MAX + 1}", "at most 64 bits"),
        ("a = inf", "a finite number"),
        ("a = 1e400", "a finite number"),
        ("a = 2021-02-30", "valid TOML"),
        ('a = """' + '\\"""' * 100_000, "valid TOML"),
        ('a = "\\u001b[31mred"', "without control characters"),
        ('a = ["\\u202e"]', "without control characters"),
        ("a = 1\na = 2", "valid TOML"),
    ],
)
def test_what_no_key_takes_is_refused_at_once(text: str, expected: str) -> None:
    begun = processor_s()
    with pytest.raises(BadInput) as caught:
        parse_toml(text, "bench.toml")
    assert processor_s() - begun < PROCESSOR_S_MAX
    assert expected in caught.value.expected
    assert len(str(caught.value)) < 600


def test_brackets_dots_and_digits_in_text_and_comments_do_not_count() -> None:
    many = "[{(" * 50 + "a." * 50 + "9" * (WORD_MAX + 1)
    text = f"# {many}\na = \"{many}\"\nb = '{many}'\nc = '''{many}'''  # {many}\nd = \"\\\"[\"\n"
    assert parse_toml(text, "bench.toml") == {"a": many, "b": many, "c": many, "d": '"['}
    assert parse_toml("a = [[1.5, 2.5], [3.5]]\nb = -9223372036854775808\n", "") == {
        "a": [[1.5, 2.5], [3.5]],
        "b": -(2**63),
    }


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "9" * 5000, "NaN", "[1e400]", '{"a": Infinity}', "1" + "0" * 200, "{", '"\\u0007"'],
)
def test_json_is_held_to_the_same_limits(text: str) -> None:
    with pytest.raises(BadInput) as caught:
        parse_json(text, "faults.jsonl", "a line", "line 3")
    assert caught.value.key.startswith("line 3")


@pytest.mark.parametrize(
    "data",
    [
        SHEET % (b"9" * 200_000),
        SHEET % (b"0x" + b"F" * 200_000),
        SHEET % (b"1_" * 200_000),
        SHEET % (b"$NODEID*" + b"9*" * 200_000 + b"9"),
        SHEET % (b"$NODEID+" + b"(" * 200_000),
        SHEET.replace(b"DataType=7", b"DataType=U" + b"9" * 5000) % b"1",
        SHEET % b"1" + b"[" + b" " * 20_000 + b"x\n",
        SHEET % b"1" + b"[1000sub" + b"_" * 100_000 + b"x]\n",
        b"\r" * 100_000 + SHEET % b"1",
    ],
)
def test_no_data_sheet_keeps_its_reader_busy(data: bytes) -> None:
    begun = processor_s()
    loaded = parse_dictionary(data, "drive.eds", 1)
    assert processor_s() - begun < PROCESSOR_S_MAX
    assert 0x1000 in loaded.dictionary


def test_a_data_sheet_cannot_speak_to_the_terminal() -> None:
    data = SHEET.replace(b"Device type", b"\x1b]0;owned\x07De\tvice \x9b2J\xe2\x80\xae") % b"1"
    loaded = parse_dictionary(data, "drive.eds", 1)
    name = loaded.dictionary[0x1000].name
    assert name.isprintable()
    assert "De vice" in name
    assert any("control character" in repair.fault for repair in loaded.repairs)
    assert all(str(repair).isprintable() for repair in loaded.repairs)


def test_what_cannot_be_written_is_bad_input_of_its_option(tmp_path: Path) -> None:
    write_file("--out", tmp_path / "text", "50 µm\n")
    assert (tmp_path / "text").read_bytes() == b"50 \xc2\xb5m\n"
    write_file("--out", tmp_path / "text", b"\xb5")
    assert (tmp_path / "text").read_bytes() == b"\xb5"
    place = tmp_path / "none" / "a.toml"
    with pytest.raises(BadInput) as refused:
        write_file("--out", place, "")
    error = refused.value
    assert (error.source, error.value, error.expected) == ("--out", str(place), "a place to write to")
    assert error.remedy == "No such file or directory"
    with pytest.raises(BadInput, match=r"--picture.*the viewer is gone"), writing("--picture", place):
        raise OSError("the viewer is gone")
    with pytest.raises(ValueError, match="a defect"), writing("--picture", place):
        raise ValueError("a defect")


def test_only_characters_that_act_are_escaped() -> None:
    assert printable("Ärger 50 µm\xa0— ok") == "Ärger 50 µm\xa0— ok"
    assert printable("a\x1b[0m\n\u202eb\x85\u2028") == "a\\x1b[0m\\n\\u202eb\\x85\\u2028"
