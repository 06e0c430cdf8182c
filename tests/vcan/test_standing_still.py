"""A bench that stands still while drive and bus go on: what it cannot have heard is told."""

import os
import re
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from struct import pack, unpack
from typing import Final

import pytest

from servobench.drivers.timebase import NS_PER_S
from servobench.hil.verdict.verdict import ExitStatus
from tests.draws import few_of
from tests.recorded_frames import candump_text
from tests.scenario.processes import HIL, Observer, family_of
from tests.stillness import Untrue
from tests.vcan.adapter import ADAPTER, drive_beside
from tests.vcan.struck_run import struck

pytestmark = pytest.mark.timeout(400)
"""Their programs are no forked ones: what these import takes an emulated machine a while."""

FLOOD, FLOOD_ID = 3000, 0x7F1
"""Many times what the kernel keeps for a bench without privileges."""
UNPRIVILEGED: Final = ("setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin")
"""Root without the right to a larger buffer than net.core.rmem_max."""
ASLEEP = Path(__file__).with_name("asleep.c")


@pytest.fixture(name="far")
def far_end(channel: str) -> Iterator[str]:
    """SPEC of the bus with the drive, behind the gateway."""
    with drive_beside(channel) as far:
        yield far


def flood_at_once() -> None:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as other:
        other.bind((ADAPTER,))
        for _ in range(FLOOD):
            other.send(pack("=IB3x8s", FLOOD_ID, 8, b""))


def stop(processes: Sequence[int], number: signal.Signals) -> None:
    for each in processes:
        os.kill(each, number)


def test_what_the_kernel_dropped_in_a_run_is_told_by_number(far: str, tmp_path: Path) -> None:
    """The bench stands still for as long as another program takes to send a burst."""
    if shutil.which(UNPRIVILEGED[0]) is None:
        pytest.skip("no setpriv of util-linux")

    def strike(_watching: Observer, command: int) -> None:
        processes = family_of(command)
        stop(processes, signal.SIGSTOP)
        flood_at_once()
        stop(processes, signal.SIGCONT)

    ended = struck(far, tmp_path, strike, passes=True, by=[*UNPRIVILEGED, *HIL])
    assert ended.status in (ExitStatus.PASSED, ExitStatus.NOT_TRUSTWORTHY), ended.said
    dropped = sum(map(int, re.findall(rf"{ADAPTER} dropped (\d+) frames", ended.events)))
    heard = candump_text(tmp_path / "run").count(f" {FLOOD_ID:X}#")
    assert 0 < heard < FLOOD
    if heard + dropped < FLOOD:
        raise Untrue(f"of {FLOOD} frames {heard} were heard, {dropped} told as dropped")
    print(f"{dropped} dropped, {heard} heard; {ended.missed} missed, {ended.lost} lost or late")


@pytest.mark.parametrize(
    ("asleep_s", "statuses"),
    few_of(
        [
            pytest.param(4.0, (ExitStatus.PEER_FAULT,), id="beyond the drive's watchdog"),
            pytest.param(0.5, (ExitStatus.PASSED, ExitStatus.NOT_TRUSTWORTHY), id="within it"),
        ],
        1,
    ),
)
def test_a_machine_that_was_suspended_is_named(
    far: str, tmp_path: Path, asleep_s: float, statuses: tuple[ExitStatus, ...]
) -> None:
    """Its monotonic clock stood still with it, and boot time went on: no tick is late."""
    library, slept = tmp_path / "asleep.so", tmp_path / "asleep"
    if shutil.which("cc") is None:
        pytest.skip("no cc")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, ASLEEP], check=True, timeout=120)
    slept.write_bytes(bytes(8))
    rested_s, ends = 0.0, ExitStatus.PEER_FAULT in statuses

    def strike(watching: Observer, command: int) -> None:
        nonlocal rested_s
        processes = family_of(command)
        stop(processes, signal.SIGSTOP)
        since = watching.now()
        if ends:
            rested_s = watching.time_to_rest(since, asleep_s) / NS_PER_S
        watching.wait(asleep_s - (watching.now() - since) / NS_PER_S)
        with slept.open("r+b") as told:
            told.write(pack("=q", watching.now() - since))
        stop(processes, signal.SIGCONT)

    by = ["env", f"LD_PRELOAD={library}", f"ASLEEP={slept}", *HIL]
    ended = struck(far, tmp_path, strike, passes=not ends, by=by)
    told_s = max(map(float, re.findall(r"this machine was suspended for ([\d.]+) s", ended.events)))
    (lag_ns,) = unpack("=q", slept.read_bytes())
    assert told_s == pytest.approx(lag_ns / NS_PER_S, abs=0.2)
    assert ended.status in statuses, ended
    assert ("prevent it from being suspended or stopped" in ended.said) is ends
    print(f"{ended.missed} missed, {ended.lost} lost or late, at rest after {rested_s:.2f} s")
