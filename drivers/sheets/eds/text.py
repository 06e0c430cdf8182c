"""Splits the bytes of a file into lines, whatever editor wrote it.

CiA 306-1 asks for ASCII. Vendors write names and comments in the code page of their Windows (1252), of their
DOS tools (850), in UTF-8, or in Chinese (GB 18030), sometimes two of these in one file. A line that is valid
UTF-8 is taken for that; all other lines with octets beyond 7Fh are read in the one code page that makes the
most likely text of them.

Repairs made to a file, and where.
"""

import codecs
import re
import unicodedata
from collections.abc import Iterable, Iterator
from typing import NamedTuple

REPAIRS_MAX = 20_000
"""Far more than a careless sheet has; a text that is no data sheet has one in each line."""
_NAME_SHOWN_MAX = 60
"""Characters of a section's name: a file may hold one as long as itself."""


class Repair(NamedTuple):
    """One fault of a file and its repair."""

    section: str
    """The section's name, or "file"."""
    fault: str
    action: str
    line: int = 0
    """Counted from 1; 0 where the fault is in no line, as when something is missing."""

    def __str__(self) -> str:
        place = f"line {self.line} " if self.line else ""
        return f"{place}[{self.section}] {self.fault}: {self.action}"


class NoDataSheet(Exception):
    """The file has more faults than any data sheet; the text says how many."""


class RepairLog:
    """Collects repairs in the order in which they are made."""

    def __init__(self) -> None:
        self._repairs: list[Repair] = []

    def add(self, section: str, fault: str, action: str, line: int = 0) -> None:
        """Note one repair. Raises NoDataSheet if it is one too many."""
        if len(self._repairs) == REPAIRS_MAX:
            raise NoDataSheet(f"more than {REPAIRS_MAX} faults, the last in line {line}")
        self._repairs.append(Repair(section[:_NAME_SHOWN_MAX], fault, action, line))

    def in_order_of_lines(self) -> tuple[Repair, ...]:
        """Return all repairs, those without a line first."""
        return tuple(sorted(self._repairs, key=lambda repair: repair.line))


_CODE_PAGES = {
    "cp1252": "Windows code page 1252",
    "cp850": "DOS code page 850",
    "latin-1": "Latin-1",
    "gb18030": "GB 18030",
}
"""In order of preference if the text is ambiguous."""

_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32", "UTF-32"),
    (codecs.BOM_UTF32_BE, "utf-32", "UTF-32"),
    (codecs.BOM_UTF8, "utf-8-sig", "UTF-8"),
    (codecs.BOM_UTF16_LE, "utf-16", "UTF-16"),
    (codecs.BOM_UTF16_BE, "utf-16", "UTF-16"),
)
_TELLING_BYTES = 100_000
"""Bytes of lines in a foreign code page that suffice to identify it; each octet is weighed."""
_LINE_END = re.compile(rb"\r{0,2}\n|\r")
_UNITS_BESIDE_NUMBERS = "°µ²³±\xd7·½¼¾"
_MARKS_OF_TRADE = "®©™§•"
_APOSTROPHE = "\u2019"
_OPENING = "“„«\u2018\u201a"
_CLOSING = "”“»\u2018" + _APOSTROPHE
_DASHES = "\u2013—"


def lines_of(data: bytes, log: RepairLog) -> list[str]:
    """The lines of a file without their ends."""
    for mark, codec, name in _MARKS:
        if data.startswith(mark):
            log.add("file", f"a byte order mark of {name}", f"read as {name}", 1)
            data = (
                data.decode(codec, errors="replace").encode() if codec != "utf-8-sig" else data[len(mark) :]
            )
            break
    else:
        data = _without_zeros(data, log)
    _note_line_ends(data, log)
    return _decoded(_LINE_END.split(data), log)


def _without_zeros(data: bytes, log: RepairLog) -> bytes:
    """UTF-16 without a mark: every other octet of the beginning is 0."""
    head = data[:400]
    for first, codec in ((1, "utf-16-le"), (0, "utf-16-be")):
        places = head[first::2]
        if len(places) > 10 and places.count(0) > 0.8 * len(places) and head[1 - first :: 2].count(0) == 0:
            log.add("file", "every other octet is 0", "read as UTF-16", 1)
            return data.decode(codec, errors="replace").encode()
    return data


def _note_line_ends(data: bytes, log: RepairLog) -> None:
    if b"\r\r\n" in data:
        log.add("file", "lines end with CR CR LF", "taken as one line end")
    elif re.search(rb"\r(?!\n)", data):
        log.add("file", "lines end with CR alone", "taken as line ends")


def _decoded(raw: list[bytes], log: RepairLog) -> list[str]:
    lines: list[str] = []
    foreign: list[int] = []
    for number, line in enumerate(raw):
        try:
            lines.append(line.decode())
        except UnicodeDecodeError:
            lines.append("")
            foreign.append(number)
    if not foreign:
        return lines
    codec = _likeliest_code_page([raw[number] for number in foreign])
    for number in foreign:
        lines[number] = raw[number].decode(codec, errors="replace")
    first = raw[foreign[0]]
    odd = next(octet for octet in first if octet > 0x7F)
    also = f", in {len(foreign)} lines" if len(foreign) > 1 else ""
    fault = f"octet {odd:02X}h is no UTF-8{also}"
    log.add("file", fault, f"read as {_CODE_PAGES[codec]}", foreign[0] + 1)
    return lines


def _likeliest_code_page(lines: Iterable[bytes]) -> str:
    text = b"\n".join(_first(lines))
    letters: dict[str, float] = {}
    for codec in _CODE_PAGES:
        try:
            letters[codec] = _likelihood(text.decode(codec), codec)
        except UnicodeDecodeError:
            continue
    # max() keeps the first of equals, which is the order of preference.
    return max(letters, key=lambda codec: letters[codec])


def _first(lines: Iterable[bytes]) -> Iterator[bytes]:
    """Yield lines, or parts of them, as many as identify the code page."""
    left = _TELLING_BYTES
    for line in lines:
        if left <= 0:
            return
        yield line if len(line) <= left else line[:left].rsplit(b" ", 1)[0]
        left -= len(line)


def _likelihood(text: str, codec: str) -> float:
    """Rate a text: the higher, the likelier that a vendor meant it; mean over its non-ASCII characters."""
    marks = [_rating(text, place, codec) for place, sign in enumerate(text) if sign > "\x7f"]
    return sum(marks) / len(marks) if marks else 0.0


def _rating(text: str, place: int, codec: str) -> float:
    sign = text[place]
    before = text[place - 1] if place else " "
    after = text[place + 1] if place + 1 < len(text) else " "
    if codec == "gb18030":
        # Chinese stands in runs; a lone one is a Latin letter that swallowed its neighbour.
        together = before > "\x7f" or after > "\x7f"
        return 1.0 if together and "\u4e00" <= sign <= "\u9fff" else 0.3 if together else -1.0
    if unicodedata.category(sign)[0] == "L" and sign not in "ªºƒ":
        return _letter_rating(sign, before, after)
    if sign in _UNITS_BESIDE_NUMBERS:
        return 0.6
    if sign in _OPENING + _CLOSING:
        return _quote_rating(sign, before, after)
    if sign in _DASHES:
        return 0.95 if before == after == " " or (before.isdecimal() and after.isdecimal()) else 0.2
    if sign in _MARKS_OF_TRADE or sign in "\xa0…":
        return 0.7
    return -1.0 if unicodedata.category(sign) in ("Cc", "Cn", "Co", "So") else -0.2


def _quote_rating(sign: str, before: str, after: str) -> float:
    """Rate a quotation mark, which has a letter on its inner side alone; only an apostrophe occurs in a
    word."""
    if before.isalpha() and after.isalpha():
        return 0.95 if sign == _APOSTROPHE else -0.5
    opens = sign in _OPENING and not before.isalnum() and after.isalnum()
    closes = sign in _CLOSING and before not in " \t=" and not after.isalnum()
    return 0.95 if opens or closes else -0.2


def _letter_rating(sign: str, before: str, after: str) -> float:
    """Rate a letter: letters belong to words, and a capital is not among small letters."""
    if not (before.isalpha() or after.isalpha()):
        return 0.1
    if sign.isupper() and (before.islower() or (after.islower() and before.isalpha())):
        return -0.3
    if sign.islower() and before.isupper() and after.isupper():
        return -0.1
    common = 1.0 if sign in "äöüßéèêàâçôîñáíóúåøæÄÖÜÉÅØ" else 0.6
    return common if before.isalpha() and after.isalpha() else 0.8 * common
