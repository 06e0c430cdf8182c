"""The journal of changes to a drive, on disk before each change: enough to restore everything.

One JSON object a line. The first tells whose drive it is; then, before each write, the object with the bytes
that it held and those that it gets; a last one tells that all was put back. Each line is on the disk (fsync)
before the write goes out, so whatever kills the program in between, no change is without its old value.

    {"journal": 1, "bus": "hub:bench", "bitrate_bit_s": 1000000, "node": 1, "vendor": ..., "nmt": 127, ...}
    {"object": "6072:00", "old": "b80b", "new": "f401"}
    {"restored": 1}
"""

import json
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from servobench.drivers.bounded_file import NamedBy, parse_json, read_lines
from servobench.drivers.canopen.bus_scan import NODES
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import Cia301, object_name
from servobench.drivers.canopen.posted import PostedDownload
from servobench.drivers.canopen.write_list import Product, WriteList
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import MISSING, BadInput, TransferAborted
from servobench.drivers.timebase import Clock
from servobench.drivers.wire.link import BusLink
from servobench.drivers.written_file import sync_folder, write_synced
from servobench.hil.write_lists import RESTORE, makers_commutation, makers_gains

_BIT_RATES: Final = range(10_000, 1 << 32)
VERSION = 1
_LINE: Final = "a line of a journal"
"""Version of its lines; any other one is refused."""
COMMANDS: Final = frozenset({Object.CONTROLWORD, Cia301.STORE_PARAMETERS, Cia301.RESTORE_DEFAULTS})
"""A write to these is a command, not a setting: there is nothing to restore."""
SET_POINTS: Final = (
    Object.MODES_OF_OPERATION,
    Object.TARGET_TORQUE,
    Object.TARGET_POSITION,
    Object.TARGET_VELOCITY,
)
"""They travel in PDOs too, where no download tells that they change."""


@dataclass(frozen=True, slots=True, order=True)
class ObjectKey:
    """Index and sub-index."""

    index: int
    sub: int

    def __str__(self) -> str:
        return f"{self.index:04X}:{self.sub:02X}"


class ObjectWrite(NamedTuple):
    """One write to the drive."""

    object: ObjectKey
    old: bytes
    new: bytes


class DriveMark(NamedTuple):
    """Identity of a drive."""

    vendor: int
    product: int
    serial: int


@dataclass(frozen=True, slots=True)
class JournalHead:
    """Whose journal it is."""

    bus: str
    node: int
    mark: DriveMark
    nmt: int | None
    """NMT state in which the drive was found; None if unknown."""
    errors: int | None = None
    """Entries of its error history 1003h; None if it has none."""
    bitrate_bit_s: int = 1_000_000
    """Bit rate of the bus; journals of earlier versions lack it."""
    loads: str = ""
    """Digest of the parameters that are being loaded: of any objects; empty: none are."""


@dataclass(slots=True)
class JournalContents:
    """The contents of a journal."""

    head: JournalHead
    changes: list[ObjectWrite] = field(default_factory=list)
    restored: bool = False
    """All that is in it was put back, and nothing was changed since."""

    def originals(self) -> dict[ObjectKey, bytes]:
        """Return the original value of each changed object, in the order of the first changes."""
        first: dict[ObjectKey, bytes] = {}
        for change in self.changes:
            first.setdefault(change.object, change.old)
        return first


class Journal:
    """The writing side."""

    def __init__(self, path: Path, head: JournalHead) -> None:
        """Begin a journal, or go on with that of the same load into the same drive, behind its last line.

        Raises BadInput if another one still waits to be restored, or no place.
        """
        waiting = _waiting_journal(path, head)
        self.path = path
        self.contents = waiting or JournalContents(head)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("r+b" if waiting else "wb")
        except OSError as error:
            raise BadInput(str(path), "", error.strerror, "a place for the journal") from error
        if waiting:
            self._file.seek(path.read_bytes().rfind(b"\n") + 1)
            self._file.truncate()
            return
        mark = head.mark._asdict()
        self._write(
            {
                "journal": VERSION,
                "bus": head.bus,
                "bitrate_bit_s": head.bitrate_bit_s,
                "node": head.node,
                **mark,
                "nmt": head.nmt,
                "errors": head.errors,
                **({"loads": head.loads} if head.loads else {}),
            }
        )
        sync_folder(path.parent)

    def note(self, *changes: ObjectWrite) -> None:
        """Put changes on the disk; only then may they be made."""
        self._write(
            *({"object": str(each.object), "old": each.old.hex(), "new": each.new.hex()} for each in changes)
        )
        self.contents.changes += changes
        self.contents.restored = False

    def note_restored(self) -> None:
        """All changes are undone."""
        self._write({"restored": 1})
        self.contents.restored = True

    def close(self) -> None:
        """Leave the file."""
        self._file.close()

    def _write(self, *records: Mapping[str, Any]) -> None:
        write_synced(self._file, b"".join(json.dumps(record).encode() + b"\n" for record in records))


def restore_command(journal: Path) -> str:
    """Return the command that restores everything in a journal."""
    return f"hil restore {shlex.quote(str(journal))}"


def append_restored(path: Path) -> None:
    """Note in a journal that all its changes are undone."""
    with path.open("ab") as file:
        write_synced(file, json.dumps({"restored": 1}).encode() + b"\n")


def read_journal(path: Path) -> JournalContents:
    """Read a journal, of which a kill may have torn the last line off. Raises BadInput.

    A torn line is a change that was never made: it was to be on the disk first.
    """
    lines = list(read_lines(path, "journal", NamedBy("JOURNAL", "", str(path))))
    whole = [line for line in lines if line.endswith("\n")]
    if lines and not lines[0].lstrip().startswith("{"):
        expected = "journal.jsonl, which hil commission and hil measure write into their folder"
        found = "a TOML file" if path.suffix == ".toml" else "another file"
        raise BadInput(str(path), "", found, expected, "hil restore FOLDER/journal.jsonl")
    records = list(_records(path, whole))
    if not records or "journal" not in records[0]:
        raise BadInput(str(path), "line 1", MISSING if not records else records[0], "the head of a journal")
    contents = JournalContents(_head(path, records[0]))
    for number, record in enumerate(records[1:], start=2):
        if "restored" in record:
            contents.restored = True
            continue
        contents.changes.append(_change(path, number, record, contents.head))
        contents.restored = False
    return contents


def _records(path: Path, lines: list[str]) -> Iterator[dict[str, Any]]:
    for number, line in enumerate(lines, start=1):
        record = parse_json(line, str(path), _LINE, f"line {number}")
        if not isinstance(record, dict):
            raise BadInput(str(path), f"line {number}", line[:60], _LINE)
        yield record


def _head(path: Path, record: dict[str, Any]) -> JournalHead:
    if record["journal"] != VERSION:
        raise BadInput(str(path), "journal", record["journal"], f"version {VERSION}")
    try:
        mark = DriveMark(int(record["vendor"]), int(record["product"]), int(record["serial"]))
        head = JournalHead(str(record["bus"]), int(record["node"]), mark, record["nmt"], record.get("errors"))
        rate = int(record.get("bitrate_bit_s", head.bitrate_bit_s))
        head = replace(head, bitrate_bit_s=rate, loads=str(record.get("loads", "")))
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(str(path), "line 1", record, "the head of a journal", str(error)) from None
    for key, value, bounds in (("node", head.node, NODES), ("bitrate_bit_s", head.bitrate_bit_s, _BIT_RATES)):
        if value not in bounds:
            raise BadInput(str(path), key, value, f"{bounds[0]} to {bounds[-1]}")
    return head


def _change(path: Path, number: int, record: dict[str, Any], head: JournalHead) -> ObjectWrite:
    try:
        index, sub = bytes.fromhex(record["object"][:4]), bytes.fromhex(record["object"][5:7])
        key = ObjectKey(int.from_bytes(index), int.from_bytes(sub))
        write = ObjectWrite(key, bytes.fromhex(record["old"]), bytes.fromhex(record["new"]))
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(str(path), f"line {number}", record, "object, old and new", str(error)) from None
    product = Product(head.mark.vendor, head.mark.product, "")
    makers = makers_commutation(product) + makers_gains(product)
    listed = (key.index, key.sub) in RESTORE or any(each.covers(key.index, key.sub) for each in makers)
    if not head.loads and not listed:
        expected = "an object that hil commission or hil measure writes (hil docs writes)"
        raise BadInput(str(path), f"line {number}", object_name(key.index, key.sub), expected)
    return write


def _waiting_journal(path: Path, head: JournalHead) -> JournalContents | None:
    contents = read_journal(path) if path.exists() else None
    if contents is None or not contents.changes or contents.restored:
        return None
    found = contents.head
    if head.loads and (found.loads, found.node, found.mark) == (head.loads, head.node, head.mark):
        return contents
    expected = "a folder without a journal that waits to be put back"
    raise BadInput("--out", "", str(path.parent), expected, restore_command(path))


class JournaledNetwork(CanopenNetwork):
    """A CANopen master; before each download to a node its journal gets what the object holds.

    Nothing may be written to a node without one.
    """

    def __init__(self, link: BusLink, clock: Clock, writes: WriteList) -> None:
        super().__init__(link, clock, writes=writes)
        self.journals: dict[int, Journal] = {}
        """By node."""
        self.taken: dict[int, dict[ObjectKey, bytes]] = {}
        """By node, the last accepted value of each object written."""
        self.putting_back = False
        """True if present writes are in the journals already."""

    @property
    def journal(self) -> Journal | None:
        """The journal of the first node, if there is only one."""
        return next(iter(self.journals.values()), None)

    def begin_journal(self, journal: Journal) -> None:
        """From now on writes to its node are allowed. The set-points are noted at once."""
        node = journal.contents.head.node
        self.journals[node] = journal
        for index in SET_POINTS:
            self._note(node, index, 0, None)

    def download(self, node_id: int, index: int, sub: int, data: bytes) -> None:
        self._note(node_id, index, sub, data)
        super().download(node_id, index, sub, data)
        self.taken.setdefault(node_id, {})[ObjectKey(index, sub)] = data

    def post_download(self, node_id: int, index: int, sub: int, data: bytes) -> PostedDownload:
        self._note(node_id, index, sub, data)
        self.taken.setdefault(node_id, {})[ObjectKey(index, sub)] = data
        return super().post_download(node_id, index, sub, data)

    def _note(self, node_id: int, index: int, sub: int, data: bytes | None) -> None:
        self.writes.check(node_id, index, sub)
        if self.putting_back:
            return
        journal = self.journals.get(node_id)
        if journal is None:
            raise AssertionError(f"a write to {index:04X}h of node {node_id} before there is a journal")
        if index in COMMANDS:
            return
        if journal.contents.head.loads and ObjectKey(index, sub) in journal.contents.originals():
            return  # noted with all others before the first write
        if index == Object.COMMUTATION_ANGLE and ObjectKey(index, sub) in journal.contents.originals():
            return  # it changes every few milliseconds: what it held at first is enough
        try:
            old = self.upload(node_id, index, sub)
        except TransferAborted:
            return  # what cannot be read cannot be put back, and is no setting
        journal.note(ObjectWrite(ObjectKey(index, sub), old, old if data is None else data))
