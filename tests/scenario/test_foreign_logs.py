"""Logs of other programs, 29 of them, held against python-can's readers and tshark's CANopen dissector."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import can
import pytest

from servobench.hil.reviewing.trace.bus_log import BusLog
from servobench.hil.reviewing.trace.decoder import decode
from servobench.hil.reviewing.trace.frame_columns import LogFrame
from tests.canopen_session import session
from tests.scenario.foreign_logs import FOREIGN, ForeignLog, capture
from tests.scenario.test_trace_witnesses import Dissected, compared, dissected

GAP_NS = 3 * 10**9
KINDS = {"nmt", "sync", "emcy", "time", "heartbeat", "sdo", "pdo", "lss"}


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list[LogFrame]:
    """Every service of CANopen, CAN FD, 29 bits, remote and error frames, and a silence of 3 s."""
    path = tmp_path_factory.mktemp("session") / "session.log"
    with pytest.MonkeyPatch.context() as patch:
        path.write_text("".join(f"{line}\n" for line in session(patch).lines))
    said = list(BusLog(path))
    half, last = len(said) // 2, said[-1]
    said[half:] = [each._replace(at_ns=(each.at_ns or 0) + GAP_NS) for each in said[half:]]
    end_ns = GAP_NS + (last.at_ns or 0)
    said += [
        LogFrame(0, end_ns + 500_000, "can0", 0x18FEF100, bytes(range(8)), extended=True),
        LogFrame(0, end_ns + 700_000, "can0", 0x3F0, bytes(range(48)), fd=True),
    ]
    return [each._replace(number=place, sent="RT"[place % 2]) for place, each in enumerate(said, start=1)]


@pytest.fixture(scope="module")
def seen(frames: Sequence[LogFrame], tmp_path_factory: pytest.TempPathFactory) -> list[Dissected]:
    """The same by tshark."""
    path = tmp_path_factory.mktemp("seen") / "session.pcap"
    capture(227, b"", "<", ">")(path, frames)
    rows = dissected(path)
    assert len(rows) == len(frames) > 600
    return rows


@pytest.mark.parametrize("log", FOREIGN, ids=[log.name for log in FOREIGN])
def test_a_log_of_another_program_says_what_was_on_the_bus(
    log: ForeignLog, frames: Sequence[LogFrame], seen: list[Dissected], tmp_path: Path
) -> None:
    held = [(frame, row) for frame, row in zip(frames, seen, strict=True) if log.holds(frame)]
    path = tmp_path / log.name
    log.write(path, [frame for frame, _ in held])
    read = BusLog(path)
    found = [frame._replace(number=place) for place, frame in enumerate(read, start=1)]
    assert read.notes() == []
    assert len(found) == len(held)
    if path.suffix == ".mf4":  # python-can of this process has no asammdf
        program = "import can, sys; print(len(list(can.LogReader(sys.argv[1]))))"
        command = [sys.executable, "-c", program, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert int(done.stdout) == len(found)
    elif log.by_python_can:
        with can.LogReader(path) as messages:
            assert len(list(messages)) == len(found)
    for frame, (true, _) in zip(found, held, strict=True):
        assert (frame.extended, frame.remote, frame.error, frame.fd) == (
            true.extended,
            true.remote,
            true.error,
            true.fd,
        )
        if not true.error:  # an asc has no content of it
            assert (frame.can_id, frame.data) == (true.can_id, true.data)
    _times_agree([frame.at_ns for frame in found], [frame.at_ns or 0 for frame, _ in held], log.step_us)
    entries = [each for each in decode(found) if each.kind not in ("other", "error")]
    agreed = compared(entries, [row for _, row in held])
    assert set(agreed) >= KINDS
    assert agreed["sdo"] > 30


def _times_agree(told: list[int | None], true: list[int], step_us: int) -> None:
    """Since the first frame: some kinds tell no date."""
    if not step_us:
        assert set(told) == {None}
        return
    for at_ns, true_ns in zip(told, true, strict=True):
        assert at_ns is not None
        assert told[0] is not None
        assert at_ns - told[0] == pytest.approx(true_ns - true[0], abs=step_us * 1000 + 1)
