"""``hil trace``: decoded bus traffic from a recording, from another program's log, or live."""

import json
import sys
from collections.abc import Iterable, Iterator
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from servobench.drivers.errors import BadInput, printable
from servobench.hil.terminal.options import (
    JsonLinesOption,
    UnsealedOption,
    bitrate_option,
    bus_option,
    flag,
    valued,
)
from servobench.hil.terminal.output import note_seal, say, write_line
from servobench.hil.terminal.supervision import is_read

if TYPE_CHECKING:
    from servobench.hil.reviewing.trace.frame_columns import FrameColumns, LogFrame
    from servobench.hil.reviewing.trace.node_objects import SheetFile
    from servobench.hil.reviewing.trace.run_trace import RecordedBus
    from servobench.hil.reviewing.trace.trace_entry import TraceEntry, TraceSelection


_SHORT_S: Final = 0.5
"""Of a window: a thousand frames of a busy bus, for which the reader by columns is not loaded."""


def trace(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RUN|LOG]",
            help="A recording, or a log: candump, pcap, pcapng, asc, blf, trc, ...; .gz; - for stdin.",
        ),
    ] = None,
    eds: Annotated[
        list[str] | None,
        valued("--eds", "[N=]FILE", "EDS, DCF, XDD or XDC of node N, or of every node; repeatable."),
    ] = None,
    node: Annotated[int | None, valued("--node", None, "Only this node.", min=1, max=127)] = None,
    kind: Annotated[
        str | None, valued("--kind", "KIND,...", "Only these kinds: pdo, sdo, emcy, nmt, ...")
    ] = None,
    from_s: Annotated[float | None, valued("--from", "T", "Start time, s.")] = None,
    to_s: Annotated[float | None, valued("--to", "T", "End time, s.")] = None,
    differences: Annotated[
        bool, flag("--differences", "The log has time differences (candump -t d).")
    ] = False,
    live: Annotated[bool, flag("--live", "Follow --bus until Ctrl-C; nothing is sent.")] = False,
    bus: Annotated[str | None, bus_option("With --live: hub:NAME, socketcan:can0, slcan:PORT, ...")] = None,
    bitrate: Annotated[
        int | None, bitrate_option("With --live: bit rate, bit/s; default: found by listening.")
    ] = None,
    unsealed: UnsealedOption = False,
    as_json: JsonLinesOption = False,
) -> None:
    """Decode a CANopen bus: NMT, SYNC, EMCY, heartbeats, SDO transfers, PDOs in SI units, LSS, error frames.

    Times are in s since the first cycle of a recording, or since the first frame of a log.

    Examples:
      hil trace runs/monday --from 0.2 --to 0.21 --kind sync,pdo
      hil trace --live --bus socketcan:can0   # a real bus
    """
    from servobench.hil.reviewing.trace.trace_entry import TraceSelection

    selection = TraceSelection(node, _kinds(kind), from_s, to_s)
    sheets = [_sheet(text) for text in eds or ()]
    if live:
        if source is not None or bus is None:
            raise BadInput("--live", "", str(source or ""), "--bus SPEC, and no RUN or LOG beside it")
        _follow(bus, bitrate, sheets, selection, as_json)
    elif source is None or bus is not None:
        raise BadInput("hil trace", "", str(bus or ""), "a RUN or LOG, or --live --bus SPEC")
    else:
        _read(source, differences, sheets, selection, unsealed, as_json)


def _read(
    source: Path, differences: bool, sheets: "list[SheetFile]", selection: "TraceSelection",
    unsealed: bool, as_json: bool,
) -> None:  # fmt: skip
    from servobench.hil.reviewing.trace.bus_log import KINDS, BusLog
    from servobench.hil.reviewing.trace.decoder import decode
    from servobench.hil.reviewing.trace.frame_columns import EVER_NS, FrameColumns
    from servobench.hil.reviewing.trace.node_objects import KnownNodes

    if source.is_dir():
        run, frames, end_ns = _recorded(source, selection, unsealed)
        if isinstance(run.log, FrameColumns) and _is_long(selection):
            _print_columns(run, run.log, sheets, selection, as_json)
            for note in run.log.notes():
                say(f"hil: note: {source}: {note}")
            return
        notes, zero_ns, known = run.log.notes, run.zero_ns, run.known(sheets)
        for note in run.notes:
            say(f"hil: note: {note}")
        first = next(frames, None)
    else:
        log, end_ns = BusLog(source, differences), EVER_NS
        notes, known, frames, zero_ns = log.notes, KnownNodes(sheets), iter(log), None
        if (first := next(frames, None)) is None:
            raise BadInput(str(source), "", log.first_malformed or log.damage or "no frame", KINDS)
    if first is not None:
        zero_ns = first.at_ns if zero_ns is None else zero_ns
        entries = decode(chain((first,), frames), known, end_ns)
        _print(selection, entries, zero_ns or 0, as_json)
    for note in notes():
        say(f"hil: note: {source}: {note}")


def _is_long(selection: "TraceSelection") -> bool:
    """Return True if the window has so many frames that they are sooner read by columns."""
    if selection.from_s is None or selection.to_s is None:
        return True
    return selection.to_s - selection.from_s > _SHORT_S


def _print_columns(
    run: "RecordedBus",
    log: "FrameColumns",
    sheets: "list[SheetFile]",
    selection: "TraceSelection",
    as_json: bool,
) -> None:
    from servobench.hil.reviewing.trace.trace_lines import TraceLines

    known = run.known(sheets)
    for note in run.notes:
        say(f"hil: note: {note}")
    zero_ns = run.zero_ns
    if zero_ns is None:
        zero_ns = next((int(frames["at"][0]) for frames, _ in log.parts() if frames.size), 0)

    def told(entry: "TraceEntry") -> str:
        return json.dumps(entry.as_json(zero_ns)) if as_json else line_of(entry, zero_ns)

    for lines in TraceLines(known, selection, zero_ns, told, as_json).of(log):
        sys.stdout.write(lines)
        if not is_read():
            return
    sys.stdout.flush()


def _recorded(
    folder: Path, selection: "TraceSelection", unsealed: bool
) -> "tuple[RecordedBus, Iterator[LogFrame], int]":
    """Return the bus of a recording, the selected frames, and the instant of the last one."""
    from servobench.hil.reviewing.trace.frame_columns import EVER_NS
    from servobench.hil.reviewing.trace.run_trace import RecordedBus
    from servobench.hil.rows.run_files import RECORDS_FILE
    from servobench.hil.rows.seal import SealedFiles, is_recording

    sealed = None if unsealed or not is_recording(folder) else SealedFiles(folder)
    if sealed is not None:
        note_seal(folder, sealed.told)
        sealed.check_small()
        sealed.check_ends(RECORDS_FILE)
    run = RecordedBus(folder)
    if run.zero_ns is not None and (window := selection.window(run.zero_ns)) is not None:
        return run, run.of_window(window, sealed), window.end_ns
    if sealed is not None:
        sealed.check_all()
    return run, iter(run), EVER_NS


def _follow(
    bus: str, bitrate: int | None, sheets: "list[SheetFile]", selection: "TraceSelection", as_json: bool
) -> None:
    from servobench.drivers.wire.adapters import parse_bus_spec
    from servobench.hil.inspecting.live_trace import live_frames
    from servobench.hil.machine.stopping import stop_signals
    from servobench.hil.reviewing.trace.decoder import decode
    from servobench.hil.reviewing.trace.node_objects import KnownNodes

    spec, known = parse_bus_spec(bus, "--bus"), KnownNodes(sheets)
    with stop_signals() as stop, closing(live_frames(spec, bitrate, stop, say)) as frames:
        _print(selection, decode(frames, known), 0, as_json)


def _print(selection: "TraceSelection", entries: "Iterable[TraceEntry]", zero_ns: int, as_json: bool) -> None:
    """Print line by line; the reader may stop early (``| head``)."""
    for entry in selection.of(entries, zero_ns):
        write_line(json.dumps(entry.as_json(zero_ns)) if as_json else line_of(entry, zero_ns))
        if not is_read():
            return
    sys.stdout.flush()


def line_of(entry: "TraceEntry", zero_ns: int) -> str:
    """An entry as ``hil trace`` prints it; ``zero_ns``: what the times count from."""
    at = f"#{entry.last}" if entry.at_ns is None else f"{(entry.at_ns - zero_ns) / 1e9:.6f}"
    node = f"node {entry.node}" if entry.node is not None else ""
    channel = f"{entry.channel:<8} " if entry.channel else ""
    sent = entry.sent or " "
    text = printable(entry.text)
    return f"{at:>14} {channel}{sent} {entry.can_id:03X}  {entry.kind:<9} {node:<8} {text}"


def _kinds(text: str | None) -> frozenset[str]:
    from servobench.hil.reviewing.trace.trace_entry import KINDS

    kinds = frozenset(part.strip().lower() for part in (text or "").split(",") if part.strip())
    if unknown := sorted(kinds - set(KINDS)):
        raise BadInput("--kind", "", unknown[0], f"of {', '.join(KINDS)}")
    return kinds


def _sheet(text: str) -> "SheetFile":
    """Parse ``FILE``, or ``5=FILE`` for node 5."""
    from servobench.drivers.canopen.nmt_states import NODE_ID_MAX
    from servobench.hil.reviewing.trace.node_objects import SheetFile

    number, equals, path = text.partition("=")
    if not equals or not number.isdecimal():
        return SheetFile(Path(text))
    if not 1 <= int(number) <= NODE_ID_MAX:
        raise BadInput("--eds", "", text, "a node-ID 1..127 before the =")
    return SheetFile(Path(path), int(number))
