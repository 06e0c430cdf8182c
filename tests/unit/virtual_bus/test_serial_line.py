"""Simulated serial lines: pace, faults, bounds, and the pseudo-terminal that goes away."""

import os
from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.drivers.wire.serial_line import HELD_BYTES_MAX, LineFull, LineGone, SerialLine
from servobench.virtual_bus.instruments.serial_line import (
    OUTPUT_BYTES_MAX,
    DeviceLine,
    LineFaults,
    LineSpoiler,
    PseudoTerminal,
)


def test_faults_are_read_and_checked() -> None:
    assert LineFaults.parse(["garble=0.25", "baud=9600", "status=0x80"]) == LineFaults(
        garble=0.25, baud=9600, status=0x80
    )
    for entry, message in [
        ("garbel=0.1", "did you mean garble"),
        ("garble", "NAME=VALUE"),
        ("garble=2", "a probability"),
        ("drop=nan", "a number not below 0"),
        ("baud=fast", "a whole number"),
        ("baud=-1", "a whole number not below 0"),
    ]:
        with pytest.raises(BadInput, match=message):
            LineFaults.parse([entry])


def _one_in_ten(name: str, *others: str) -> LineFaults:
    return LineFaults.parse([f"{name}=0.1", *others])


def test_each_fault_strikes_as_often_as_it_should_and_from_its_own_stream() -> None:
    line = b"S 1500T0.600R\r\n"
    for name in ("drop", "garble", "truncate", "noise", "terminator"):
        spoiler = LineSpoiler(_one_in_ten(name), seed=3)
        spoilt = [spoiler.spoil(line) for _ in range(4000)]
        changed = [one for one in spoilt if one != line]
        assert spoiler.spoilt == len(changed)
        assert 0.08 < len(changed) / 4000 < 0.12, name
        # other faults beside it leave it as it was
        again = LineSpoiler(_one_in_ten(name, "refuse=0.5"), seed=3)
        assert [again.spoil(line) for _ in range(4000)] == spoilt


def test_no_fault_changes_nothing() -> None:
    spoiler = LineSpoiler(LineFaults(), seed=1)
    assert all(spoiler.spoil(b"z\r") == b"z\r" for _ in range(100))


def test_a_line_of_9600_baud_takes_its_time_in_both_directions() -> None:
    terminal = PseudoTerminal()
    line = DeviceLine(terminal, LineFaults(baud=9600), seed=0)
    host = SerialLine(terminal.path, 9600)
    line.start(Instant(0))
    line.send(b"S 1500T0.600R\r\n", Instant(0))
    line.flush(Instant(15 * NS_PER_MS))
    assert host.read() == b""
    line.flush(Instant(16 * NS_PER_MS))
    assert host.read() == b"S 1500T0.600R\r\n"
    said = b"Q1,0.600\r\nOD1\r\n*IDN?\r\n"
    host.write(said)
    at = Instant(NS_PER_S)
    first = line.read(at)
    assert len(first) < len(said)
    assert line.holds_back(at)
    due = line.due_at()
    assert due is not None
    assert due - at == pytest.approx(len(first) * 10 / 9600 * NS_PER_S, abs=1)
    assert line.read(Instant(due - 1)) == b""
    rest = b"".join(line.read(Instant(due + n * NS_PER_S)) for n in range(3))
    assert first + rest == said
    host.close()
    terminal.unplug()


def test_a_host_that_does_not_read_costs_lines_and_no_waiting() -> None:
    terminal = PseudoTerminal()
    line = DeviceLine(terminal, LineFaults(), seed=0)
    text = b"x" * 999 + b"\r"
    sent = [line.send(text, Instant(0)) for _ in range(200)]
    assert not all(sent)
    assert line.lines_lost == sent.count(False)
    assert sum(sent) * 1000 <= OUTPUT_BYTES_MAX + 2 * 4096 * 4
    terminal.unplug()


def test_unplugging_is_seen_by_the_host_and_comes_at_its_time(tmp_path: Path) -> None:
    link = tmp_path / "port"
    terminal = PseudoTerminal(link)
    line = DeviceLine(terminal, LineFaults(unplug_after_s=1.0), seed=0)
    host = SerialLine(str(link), 115200)
    line.start(Instant(0))
    line.flush(Instant(NS_PER_S - 1))
    assert host.read() == b""
    assert os.readlink(link) == terminal.path
    line.flush(Instant(NS_PER_S))
    assert not terminal.plugged
    assert not link.is_symlink()
    with pytest.raises(LineGone, match="is gone"):
        host.read()
    with pytest.raises(LineGone, match="is gone"):
        host.write(b"C\r")
    host.close()


def test_a_link_replaces_a_stale_one_and_no_file(tmp_path: Path) -> None:
    link = tmp_path / "port"
    link.symlink_to("/dev/pts/nobody")
    terminal = PseudoTerminal(link)
    assert os.readlink(link) == terminal.path
    terminal.unplug()
    link.write_text("mine")
    with pytest.raises(BadInput, match="symbolic link"):
        PseudoTerminal(link)
    assert link.read_text() == "mine"


def test_a_port_that_takes_nothing_more_holds_a_bounded_rest() -> None:
    terminal = PseudoTerminal()
    host = SerialLine(terminal.path, 115200)

    def flood() -> None:
        for _ in range(100):
            host.write(b"y" * 1000)

    with pytest.raises(LineFull, match="takes no more"):
        flood()
    assert host.held_bytes <= HELD_BYTES_MAX
    taken = 0
    while data := terminal.read():
        taken += len(data)
        host.read()
    assert taken % 1000 == 0, "a write was cut"
    assert host.held_bytes == 0
    host.close()
    terminal.unplug()
