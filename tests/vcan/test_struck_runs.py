"""A run whose adapter is struck and stays so: what it says, where it ends, and how soon the drive rests."""

import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.scenario.processes import Observer, changed_bench
from tests.vcan.adapter import (
    ADAPTER,
    CHECK,
    UNACKNOWLEDGED,
    adapter_beside,
    drive_beside,
    error,
    hold,
    run_tool,
    set_up,
)
from tests.vcan.struck_run import END_LIMIT_S, struck
from tests.warm.start import hil

OTHER_NAME = "can8"


@pytest.fixture(name="far")
def far_end(channel: str) -> Iterator[str]:
    """SPEC of the bus with the drive, behind the gateway."""
    with drive_beside(channel) as far:
        yield far


def unacknowledged() -> None:
    error(UNACKNOWLEDGED)  # a full queue would take none
    hold()


@pytest.mark.parametrize(
    ("strike", "cure", "events"),
    [
        pytest.param(
            lambda: set_up(False),
            f"ip link set {ADAPTER} up",
            ["is down"],
            id="down for good",
        ),
        pytest.param(
            unacknowledged,
            CHECK,
            ["what nobody acknowledges", "takes no frames"],
            id="wrong bit rate, or no other node",
        ),
    ],
)
def test_what_stays_so_ends_the_run_with_the_drive_at_rest_and_says_what_mends_it(
    far: str, tmp_path: Path, strike: Callable[[], None], cure: str, events: list[str]
) -> None:
    ended = struck(far, tmp_path, lambda _watching, _command: strike(), passes=False)
    assert ended.status == 3, ended
    assert ended.rest_s is not None
    assert cure in ended.said
    assert all(text in ended.events for text in events), ended.events
    print(f"at rest after {ended.rest_s:.2f} s; {ended.missed} missed, {ended.lost} lost or late")


@pytest.mark.usefixtures("far")
def test_an_adapter_that_takes_nothing_ends_a_command_before_anything_moves(tmp_path: Path) -> None:
    """As where the bit rate is wrong: nobody acknowledges, and the queue is full."""
    hold()
    for words in (["run", str(changed_bench(tmp_path))], ["measure", "--node", "1"]):
        command = [*hil(), *words, "--bus", f"socketcan:{ADAPTER}"]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=END_LIMIT_S, check=False)
        assert ran.returncode == 3, ran.stderr
        assert "its queue is full as nobody acknowledges, or it is down" in ran.stderr
        assert "enabling" not in ran.stderr


def test_an_adapter_that_is_back_under_another_name_is_named_by_the_next_run(
    far: str, tmp_path: Path
) -> None:
    with ExitStack() as back:

        def strike(_watching: Observer, _command: int) -> None:
            run_tool("ip", "link", "del", ADAPTER)
            back.enter_context(adapter_beside(far.partition(":")[2], OTHER_NAME))

        ended = struck(far, tmp_path, strike, passes=False)
        command = [*hil(), "run", str(changed_bench(tmp_path)), "--bus", f"socketcan:{ADAPTER}"]
        again = subprocess.run(command, capture_output=True, text=True, timeout=END_LIMIT_S, check=False)
    assert (ended.status, again.returncode) == (3, 3), (ended, again)
    assert "the adapter was unplugged" in ended.said
    assert "plug it in again; hil scan tells the name that it has then" in ended.said
    assert "plug it in; there is " in again.stderr
    assert f"socketcan:{OTHER_NAME}" in again.stderr
    print(f"at rest after {ended.rest_s:.2f} s; {ended.missed} missed, {ended.lost} lost or late")
