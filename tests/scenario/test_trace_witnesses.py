"""`hil trace` held against tshark's CANopen dissector, frame by frame, and against python canopen's values.

Where tshark is silent or wrong it is no witness: it takes each segment of an SDO block for a command, and
leaves remote frames alone. There canopen and the CRC of the transfer stand in.
"""

import os
import shutil
import subprocess
from collections import defaultdict
from pathlib import Path
from struct import pack
from typing import NamedTuple

import pytest

from servobench.hil.reviewing.trace.bus_log import BusLog
from servobench.hil.reviewing.trace.decoder import decode
from servobench.hil.reviewing.trace.node_objects import KnownNodes, SheetFile
from servobench.hil.reviewing.trace.run_trace import RecordedBus
from servobench.hil.reviewing.trace.trace_entry import TraceEntry
from servobench.hil.rows.records_file import read_table
from servobench.hil.rows.run_files import RECORDS_FILE
from servobench.hil.testing.bench_runs import BenchRunner
from tests.canopen_session import TEXT, Witnessed, session
from tests.recorded_frames import candump
from tests.scenario.foreign_logs import SLL2_HEAD, SLL_HEAD, capture
from tests.scenario.processes import EXAMPLES
from tests.scenario.test_recording_is_read_by_others import TSHARK_MAX_S, lacking
from tests.unit.virtual_bus.device_bench import NODE, NOTE, TARGET

FIELDS = (
    "_ws.col.Info", "canopen.nmt_ctrl.cd", "canopen.nmt_ctrl.node_id", "canopen.sync.counter",
    "canopen.em.err_code",
    "canopen.time_stamp_ms", "canopen.time_stamp_days", "canopen.nmt_guard.state", "canopen.lss.cs",
    "canopen.pdo.data.bytes", "canopen.sdo.main_idx", "canopen.sdo.sub_idx", "canopen.sdo.data.bytes",
    "canopen.sdo.abort_code", "can.id",
)  # fmt: skip
NMT = {0x01: "start", 0x02: "stop", 0x80: "enter pre operational", 0x81: "reset node"}
STATES = {0x00: "boot-up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}


class Dissected(NamedTuple):
    """A frame as tshark has it."""

    fields: dict[str, str]

    def number(self, field: str) -> int:
        return int(self.fields[field], 0)


def tshark(*arguments: str) -> str:
    program = os.environ.get("TSHARK") or shutil.which("tshark")
    if program is None:
        lacking("tshark")
    command = [str(program), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TSHARK_MAX_S, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def dissected(log: Path) -> list[Dissected]:
    fields = [part for name in FIELDS for part in ("-e", name)]
    told = tshark("-r", str(log), "-d", "can.subdissector,canopen", "-T", "fields", *fields)
    return [Dissected(dict(zip(FIELDS, line.split("\t"), strict=True))) for line in told.splitlines()]


@pytest.fixture
def witnessed(monkeypatch: pytest.MonkeyPatch) -> Witnessed:
    return session(monkeypatch)


@pytest.fixture
def log(witnessed: Witnessed, tmp_path: Path) -> Path:
    path = tmp_path / "session.log"
    path.write_text("".join(f"{line}\n" for line in witnessed.lines))
    return path


def sheets(witnessed: Witnessed, folder: Path) -> KnownNodes:
    path = folder / "device.eds"
    path.write_text(witnessed.sheet, encoding="latin-1")
    return KnownNodes([SheetFile(path, NODE)])


def agrees(entry: TraceEntry, seen: Dissected) -> bool:
    """One frame that is no SDO."""
    info, data = seen.fields["_ws.col.Info"], entry.data
    if entry.kind == "nmt":
        command, node = seen.number("canopen.nmt_ctrl.cd"), seen.number("canopen.nmt_ctrl.node_id")
        return entry.text.startswith(NMT[command]) and (entry.node or 0) == node
    if entry.kind == "sync":
        counter = seen.fields["canopen.sync.counter"]
        return info.startswith("SYNC") and dict(entry.details).get("counter") == (
            int(counter) if counter else None
        )
    if entry.kind == "emcy":
        return bool(dict(entry.details)["error_code"] == seen.number("canopen.em.err_code"))
    if entry.kind == "time":
        ms, days = seen.number("canopen.time_stamp_ms"), seen.number("canopen.time_stamp_days")
        return data == pack("<IH", ms, days)
    if entry.kind in ("heartbeat", "guarding") and data:
        return entry.text.startswith(STATES[seen.number("canopen.nmt_guard.state")])
    if entry.kind == "guarding":
        return "Remote Transmission Request" in info
    if entry.kind == "lss":
        return data[0] == seen.number("canopen.lss.cs") and ("Slave" in info) == entry.text.startswith(
            "answer"
        )
    if entry.kind == "error":
        return info.removeprefix("ERR: ").lower() in entry.text
    return (
        entry.kind == "pdo" and info.startswith("PDO") and data.hex() == seen.fields["canopen.pdo.data.bytes"]
    )


def transfer_agrees(entry: TraceEntry, seen: list[Dissected]) -> bool:
    """All frames of one transfer that is no block: object, bytes and abort code."""
    told = dict(entry.details)
    named = {(row.number("canopen.sdo.main_idx"), row.number("canopen.sdo.sub_idx"))
             for row in seen if row.fields["canopen.sdo.main_idx"]}  # fmt: skip
    content = b"".join(bytes.fromhex(row.fields["canopen.sdo.data.bytes"]) for row in seen)
    if told["transfer"] == "segmented":  # the size in the initiate frame is no content
        sized = [
            row for row in seen if row.fields["canopen.sdo.main_idx"] and row.fields["canopen.sdo.data.bytes"]
        ]
        content = content[4 * len(sized) :]
    aborts = [row.number("canopen.sdo.abort_code") for row in seen if row.fields["canopen.sdo.abort_code"]]
    same = content[: len(entry.data)] == entry.data and not any(content[len(entry.data) :])
    return named == {(told["index"], told["sub"])} and same and aborts == [told["abort_code"]] * len(aborts)


def compared(entries: list[TraceEntry], rows: list[Dissected]) -> dict[str, int]:
    """How many of each kind agree. Error: AssertionError, with the first that does not."""
    agreed: dict[str, int] = defaultdict(int)
    for entry in entries:
        if entry.kind != "sdo":
            assert agrees(entry, rows[entry.last - 1]), (entry, rows[entry.last - 1])
        elif dict(entry.details)["transfer"] != "block":
            channel = {0x580 + (entry.node or 0), 0x600 + (entry.node or 0)}
            between = rows[entry.first - 1 : entry.last]
            seen = [row for row in between if row.fields["can.id"] and row.number("can.id") in channel]
            assert len(seen) == entry.frames
            assert transfer_agrees(entry, seen), (entry, seen)
        agreed[entry.kind] += 1
    return dict(agreed)


def speeds_are_those_of_the_records(folder: Path, entries: list[TraceEntry], zero_ns: int) -> None:
    """By the stamp of the frame, to the microsecond that candump has."""
    table = read_table(folder / RECORDS_FILE).select(["received_at", "velocity_rad_s"])
    recorded = {
        at // 1000: speed for at, speed in zip(*table.to_pydict().values(), strict=True) if at is not None
    }
    traced = {
        ((entry.at_ns or 0) - zero_ns) // 1000: value.si
        for entry in entries
        if entry.kind == "pdo"
        for value in entry.values
        if value.index == 0x606C
    }
    both = recorded.keys() & traced.keys()
    assert len(both) > 0.9 * len(recorded) > 200
    assert max(abs(recorded[at]) for at in both) > 50.0
    assert {at: traced[at] for at in both} == pytest.approx({at: recorded[at] for at in both})


def test_tshark_agrees_on_a_run_frame_by_frame(servo_bench: BenchRunner, tmp_path: Path) -> None:
    run = servo_bench(EXAMPLES / "ling2012.toml", {"bench.duration_s": 0.3, "load.axis1": []})
    capture = tmp_path / "frames.pcapng"
    tshark("-r", str(candump(run.folder)), "-w", str(capture))
    recorded = RecordedBus(run.folder)
    entries = list(decode(recorded, recorded.known([])))
    agreed = compared(entries, dissected(capture))
    assert sum(entry.frames for entry in entries) == len(run.wire.frames) > 1500
    assert agreed["pdo"] > 900
    assert agreed["sdo"] > 300
    assert {"nmt", "sync", "heartbeat"} < set(agreed)
    assert [entry.text for entry in decode(BusLog(capture), recorded.known([]))] == [e.text for e in entries]
    speeds_are_those_of_the_records(run.folder, entries, recorded.zero_ns or 0)


def test_tshark_agrees_on_all_services_and_on_long_transfers(log: Path) -> None:
    entries = list(decode(BusLog(log)))
    agreed = compared(entries, dissected(log))
    assert set(agreed) == {
        "nmt",
        "sync",
        "emcy",
        "time",
        "heartbeat",
        "guarding",
        "sdo",
        "pdo",
        "lss",
        "error",
    }
    assert sum(entry.frames for entry in entries) == len(log.read_text().splitlines())
    assert sum(dict(entry.details).get("transfer") == "segmented" for entry in entries) == 3


def test_canopen_read_the_same_values(log: Path, witnessed: Witnessed, tmp_path: Path) -> None:
    last = {
        (value.index, value.sub): value.raw if (value.index, value.sub) != (NOTE, 0) else entry.data
        for entry in decode(BusLog(log), sheets(witnessed, tmp_path))
        if entry.kind == "sdo" and dict(entry.details)["abort_code"] is None
        for value in entry.values
    }
    assert {key: last[key] for key in witnessed.values} == witnessed.values


def test_canopen_read_the_same_pdo_as_it_was_remapped_on_the_bus(log: Path, witnessed: Witnessed) -> None:
    """Without a data sheet: the mapping is what SDO told, and 6100h has no type, so no sign."""
    remapped = [entry for entry in decode(BusLog(log)) if entry.can_id == 0x3A0]
    target, stamp = (value.raw for value in remapped[0].values)
    assert [(value.index, value.sub) for value in remapped[0].values] == [(TARGET, 0), (0x1013, 0)]
    assert (target, stamp) == (witnessed.pdo[0] & 0xFFFF, witnessed.pdo[1])


def test_a_data_sheet_gives_the_pdo_its_names_and_signs(
    log: Path, witnessed: Witnessed, tmp_path: Path
) -> None:
    entries = list(decode(BusLog(log), sheets(witnessed, tmp_path)))
    target, stamp = next(entry.values for entry in entries if entry.can_id == 0x3A0)
    assert (target.name, target.raw, stamp.raw) == ("Target", *witnessed.pdo)


def test_block_transfers_are_whole(log: Path) -> None:
    blocks = [entry for entry in decode(BusLog(log)) if dict(entry.details).get("transfer") == "block"]
    assert [entry.data for entry in blocks] == [TEXT, TEXT]
    assert [dict(entry.details)["notes"] for entry in blocks] == [[], []]


def test_captures_of_an_interface_are_read_as_tshark_reads_them(log: Path, tmp_path: Path) -> None:
    frames, infos = list(BusLog(log)), [row.fields["_ws.col.Info"] for row in dissected(log)]
    expected = [(frame.at_ns, frame.can_id, frame.data, frame.remote, frame.error) for frame in frames]
    for name, kind, head, order, id_order in (
        ("socketcan", 227, b"", "<", ">"),
        ("cooked", 113, SLL_HEAD, "<", "<"),
        ("cooked 2", 276, SLL2_HEAD, ">", ">"),
    ):
        path = tmp_path / f"{name}.pcap"
        capture(kind, head, order, id_order)(path, frames)
        again = list(BusLog(path))
        assert [(f.at_ns, f.can_id, f.data, f.remote, f.error) for f in again] == expected, name
        assert [row.fields["_ws.col.Info"] for row in dissected(path)] == infos, name
        assert {frame.sent for frame in again} == {"T" if head else ""}
    converted = tmp_path / "again.pcapng"
    tshark("-r", str(tmp_path / "socketcan.pcap"), "-w", str(converted))
    assert [(f.at_ns, f.can_id, f.data, f.remote, f.error) for f in BusLog(converted)] == expected


def test_a_log_that_can_utils_has_rewritten_is_the_same(log: Path, tmp_path: Path) -> None:
    """log2long prints as candump does on a terminal."""
    program = os.environ.get("LOG2LONG") or shutil.which("log2long")
    if program is None:
        lacking("log2long of can-utils")
    shown = subprocess.run(
        [str(program)], input=log.read_bytes(), capture_output=True, timeout=TSHARK_MAX_S, check=True
    )
    rewritten = tmp_path / "long.log"
    rewritten.write_bytes(shown.stdout)
    assert shown.stdout != log.read_bytes()
    assert list(BusLog(rewritten)) == list(BusLog(log))
