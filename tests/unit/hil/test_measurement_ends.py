"""Every way out of a measurement of simulated drives: what is left, and what failed told with its cure."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.measuring.figures import Measured
from servobench.hil.restoring.journal import read_journal
from servobench.hil.restoring.restore import restore
from tests.scenario.cut_bus import CutBus
from tests.scenario.measuring import Rig, measuring_rig

CYCLES = 50


class Leaving:
    """Takes the progress of a measurement; when it leaves, or before, something happens to it."""

    def __init__(self, rig: Rig) -> None:
        self.stages: list[str] = []
        self.raises: BaseException | None = None
        """While it measures."""
        self.cut = CutBus(rig.world.link.bus)
        self.whole = rig.world
        self.elapsed_s: dict[str, float] = {}
        self.at_the_end: Callable[[], object] = lambda: None
        """Done when it begins to leave."""
        link = BusLink(self.cut, rig.world.clock, StampSource.MONOTONIC, "simulated")
        rig.world = replace(rig.world, link=link)

    def __call__(self, phase: str, elapsed_s: float) -> None:
        self.elapsed_s[phase] = elapsed_s
        if self.stages[-1:] != [phase]:
            self.stages.append(phase)
        if phase == "measuring" and self.raises is not None:
            raise self.raises
        if phase == "putting back":
            self.at_the_end()

    def unplug(self) -> None:
        self.cut.unplugged_at = self.cut.sent


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with measuring_rig(tmp_path, nodes=(1, 2)) as made:
        yield made


def measure(rig: Rig, leaving: Leaving) -> Measured:
    return rig.measure(progress=leaving, cycles=CYCLES, enable=True, period_us=2000)


def states(rig: Rig) -> set[State]:
    return {servo.drive.power.state for servo in rig.servos}


def test_all_is_as_before_and_the_journals_are_gone(rig: Rig) -> None:
    before, leaving = rig.memory(), Leaving(rig)
    assert measure(rig, leaving).cycles == CYCLES
    assert leaving.elapsed_s["putting back"] == 0.0
    assert leaving.elapsed_s["measuring"] == leaving.elapsed_s["evaluating"] == CYCLES * 0.002
    assert leaving.stages == [
        "connecting", "configuring", "calibrating", "enabling", "measuring", "putting back", "evaluating",
    ]  # fmt: skip
    assert (rig.said, rig.folder.exists(), states(rig)) == ([], False, {State.SWITCH_ON_DISABLED})
    rig.world = leaving.whole
    assert rig.memory() == before


def test_a_folder_with_something_else_in_it_stays(rig: Rig) -> None:
    rig.folder.mkdir()
    (rig.folder / "mine").touch()
    measure(rig, Leaving(rig))
    assert [path.name for path in rig.folder.iterdir()] == ["mine"]


@pytest.mark.parametrize("error", [None, KeyboardInterrupt(), ZeroDivisionError()])
def test_drives_that_answer_no_more_are_told_with_the_command_that_puts_them_back(
    rig: Rig, error: BaseException | None
) -> None:
    """An error of the run comes out in the place of theirs."""
    before, leaving = rig.memory(), Leaving(rig)
    leaving.at_the_end, leaving.raises = leaving.unplug, error
    with pytest.raises(PeerFault if error is None else type(error)) as caught:
        measure(rig, leaving)
    journals = [rig.folder / f"node{node}.jsonl" for node in (1, 2)]
    for node, journal in enumerate(journals, 1):
        assert any(said.startswith(f"node {node} is not confirmed at rest: ") for said in rig.said)
        assert f"hil restore {journal}" in rig.said
    assert len(rig.said) == 6, "and why each could not be put back"
    if error is None:
        assert str(caught.value) == f"not everything is as it was; {'; '.join(rig.said)}"
    assert leaving.stages[-1] == "putting back", "nothing is evaluated"
    assert not read_journal(journals[0]).restored
    rig.world = leaving.whole
    network = CanopenNetwork(rig.world.link, rig.world.clock)
    network.pump(network.deadline_after(Duration(2 * NS_PER_S)))
    assert State.OPERATION_ENABLED not in states(rig), "each stops by itself: its host is gone"
    assert all(restore(network, read_journal(journal)).complete for journal in journals)
    assert rig.memory() == before


@pytest.mark.parametrize("error", [KeyboardInterrupt(), PeerFault("it failed")])
def test_an_error_of_the_run_comes_out_after_everything_was_put_back(rig: Rig, error: BaseException) -> None:
    before, leaving = rig.memory(), Leaving(rig)
    leaving.raises, leaving.cut.frame_port.cure = error, "put its plug in"
    with pytest.raises(type(error)) as caught:
        measure(rig, leaving)
    told = "; put its plug in" if isinstance(error, PeerFault) else ""
    assert str(caught.value).removeprefix("it failed") == told, "what mends the adapter goes with a fault"
    assert (rig.said, rig.folder.exists(), states(rig)) == ([], False, {State.SWITCH_ON_DISABLED})
    rig.world = leaving.whole
    assert rig.memory() == before


def test_what_is_put_back_is_noted_in_a_journal_that_has_to_stay(rig: Rig) -> None:
    """Node 2 refuses what it held; and node 1 watches its host no more when it is let go."""
    leaving = Leaving(rig)
    first, second = (servo.dictionary for servo in rig.servos)

    def spoil() -> None:
        first.download(0x1016, 1, bytes(4))
        held = second.variable(0x6072)
        held.show_instead(int(held.read()) + 1)

    leaving.at_the_end = spoil
    with pytest.raises(PeerFault, match=r"^not everything is as it was; 6072:00 holds "):
        measure(rig, leaving)
    unwatched, differs, command = rig.said
    assert unwatched.startswith("node 1: ")
    assert "1016h" in unwatched
    assert differs.startswith("6072:00 holds ")
    assert command == f"hil restore {rig.folder / 'node2.jsonl'}"
    done, waits = (read_journal(rig.folder / f"node{node}.jsonl") for node in (1, 2))
    assert (done.restored, waits.restored) == (True, False)
    lines = (rig.folder / "node1.jsonl").read_text().splitlines()
    assert lines[-1] == '{"restored": 1}'
    assert sum('"6072:00"' in line for line in lines) == 1, "putting it back is no change"
