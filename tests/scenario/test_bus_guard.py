"""What others do on the bus of a run is told when it happens, counted, and ends the run where it is to."""

from typing import Any

import can
import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import AnswersTwice, BenchError, DriveInFault
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.execution.bus_guard import ForeignTraffic
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.run import Run
from servobench.hil.verdict.verdict import VerdictKind
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from tests.draws import few_of
from tests.scenario.foreign_node import LATE, Act, ForeignNode, beside_the_bench
from tests.scenario.processes import EXAMPLES

ANY_BUS = EXAMPLES / "any_bus.toml"
BENCH = EXAMPLES / "ling2012.toml"
QUIET = {"bench.duration_s": 0.5, "verdict": {}, "load": {}}
AT_S = 0.4
"""After power-on; connecting, configuring and enabling take 0.2 s."""

MARK = Frame(0x089, bytes.fromhex("0010010000000000"))
MARK_S = AT_S - 0.05

FOREIGN = {
    "RPDO1 of node 1 (201h) that the bench did not send": Frame(0x201, bytes.fromhex("0F000000")),
    "NMT command (000h) that the bench did not send": Frame(0x000, b"\x01\x01"),
    "SYNC (080h) that the bench did not send": Frame(0x080),
    "heartbeat of node 127 (77Fh) that the bench did not send": Frame(0x77F, b"\x05"),
    "SDO read from node 1 (601h) that the bench did not send": Frame(
        0x601, bytes.fromhex("4000100000000000")
    ),
    "SDO write of 607Eh:00 to node 1 (601h) that the bench did not send": Frame(
        0x601, bytes.fromhex("2F7E600000000000")
    ),
    "1016h of node 1 changed by another: it may no longer watch the bench": Frame(
        0x601, bytes.fromhex("2316100100000000")
    ),
}


def run(servo_bench: BenchRunner, *nodes: Any, guard: Any = None, ends_in: Any = None, **more: Any) -> Run:
    changes = QUIET if guard is None else {**QUIET, "guard": guard}
    with beside_the_bench(*nodes, **more):
        return servo_bench(BENCH, changes, faults={}, ends_in=ends_in)


def others(run: Run) -> dict[str, int]:
    assert run.summary.timing is not None
    found: dict[str, int] = run.summary.timing["others"]
    return found


def events(run: Run, beginning: str) -> list[Any]:
    return [event for event in run.events if event.get("text", "").startswith(beginning)]


def marked(run: Run, event: dict[str, Any], mark: ForeignNode, node: ForeignNode) -> bool:
    """Whether an event is as long after that of ``mark``, whatever it counts from, as their frames are."""
    (first,) = events(run, "node 9: EMCY 1000h")
    apart = event["at_ns"] - first["at_ns"] - (node.sent_at[0] - mark.sent_at[0])
    return bool(abs(apart) < LATE)


def test_a_run_by_itself_sees_nobody(servo_bench: BenchRunner) -> None:
    assert others(run(servo_bench)) == {}


@pytest.mark.parametrize("what", few_of([*reversed(FOREIGN)], 3))
def test_a_frame_of_another_on_the_benchs_identifiers_is_told(servo_bench: BenchRunner, what: str) -> None:
    node, mark = ForeignNode(FOREIGN[what], AT_S, times=3), ForeignNode(MARK, MARK_S)
    seen = run(servo_bench, node, mark)
    assert others(seen)[what] == 3
    first, last = events(seen, what)
    assert first["level"] == ("INFO" if "read" in what else "WARN")
    assert marked(seen, first, mark, node)
    assert last["text"] == f"{what}: 3 times in all"


PHASES = {"connecting": 0.02, "running": AT_S, "stopping": 0.71}
"""After power-on; the shaft is confirmed at rest for 0.1 s after the last cycle."""
DISTURBING = {
    "SDO answer too many (581h)": Frame(0x581, bytes.fromhex("4300100092010200")),
    **{
        what: frame
        for what, frame in FOREIGN.items()
        if not any(other in what for other in ("read", "1016h", "NMT"))
    },
    "NMT command (000h)": Frame(0x000, b"\x07\x00"),
}
"""Frames with which a run goes on to its end; 07h is no command of NMT."""


@pytest.mark.parametrize("phase", PHASES)
def test_what_others_send_in_any_phase_is_a_finding_and_no_run_passes_with_it(
    servo_bench: BenchRunner, phase: str
) -> None:
    """A foreign command to switch off ends a run that goes on."""
    frames = {what: frame for what, frame in DISTURBING.items() if phase != "running" or "RPDO" not in what}
    changes = {**QUIET, "verdict": {"dropouts_percent_max": 99, "missed_percent_max": 99}}

    def disturbed(changes: dict[str, Any]) -> Run:
        first_s = PHASES[phase]
        nodes = [ForeignNode(frame, first_s + 0.001 * n, times=2) for n, frame in enumerate(frames.values())]
        with beside_the_bench(*nodes):
            return servo_bench(BENCH, changes, faults={})

    allow = ["nmt", "sync", "heartbeat", "sdo_write", "sdo_answer", "rpdo", "tpdo"]
    seen, passed = disturbed(changes), disturbed({**changes, "guard.allow": allow})
    verdict = seen.summary.verdict
    assert (verdict.outcome, verdict.exit_status) == (VerdictKind.PASSED_DISTURBED, 4)
    for what, frame in frames.items():
        (text,) = [text for text in verdict.of(VerdictKind.DISTURBED) if what in text]
        assert f"data {frame.data.hex(' ').upper() or 'none'}, at " in text
    with pytest.raises(AssertionError, match="disturbed: "):
        seen.assert_passed()
    passed.assert_passed()
    assert others(passed).keys() == others(seen).keys()


@pytest.mark.parametrize("what", few_of([*FOREIGN], 2))
def test_it_ends_the_run_where_the_bench_says_so(servo_bench: BenchRunner, what: str) -> None:
    node = ForeignNode(FOREIGN[what], AT_S, times=3)
    seen = run(servo_bench, node, guard={"on_foreign": "stop", "allow": []}, ends_in=ForeignTraffic)
    assert what in str(seen.error)
    assert BenchError.exit_status == ForeignTraffic.exit_status == 3
    seen.assert_reached(State.SWITCH_ON_DISABLED, by_s=0.5)


def test_a_drive_that_ceased_to_watch_the_host_has_not_passed(servo_bench: BenchRunner) -> None:
    """By itself: no frame tells of it until its 1016h is read back, when it is at rest."""
    drives: list[SimulatedServo] = []

    def forget(_now: Instant) -> None:
        drives[0].dictionary.variable(0x1016, 1).value = 0

    quiet = servo_bench(BENCH, QUIET, faults={})
    assert quiet.summary.verdict.exit_status == 0
    with beside_the_bench(Act(AT_S, forget), seen=drives.append):
        seen = servo_bench(BENCH, QUIET, faults={})
    what = "axis1: 1016h:01 held 00000000h at the end, 007F0096h was written: it did not watch the host"
    assert seen.summary.verdict.exit_status == 3
    assert seen.summary.verdict.reason == what
    assert [event["level"] for event in events(seen, what)] == ["ERROR"]


def test_readings_beyond_the_syncs_are_told(servo_bench: BenchRunner) -> None:
    spoofed = Frame(0x181, bytes(8))
    seen = run(servo_bench, ForeignNode(spoofed, AT_S, times=40, period_s=0.0005))
    # two of them a period, alike: one and what may be its repetition
    assert others(seen)["TPDO1 of node 1 (181h): more than the SYNCs ask for"] == 20


def test_answers_that_nobody_asked_for_are_told_or_end_the_run(servo_bench: BenchRunner) -> None:
    answer = Frame(0x581, bytes.fromhex("4300100092010200"))
    what = "node 1 sends more answers than requested: two nodes are likely to have its id"
    assert others(run(servo_bench, ForeignNode(answer, AT_S, times=5))) == {what: 5}
    ended = run(
        servo_bench, ForeignNode(answer, AT_S, times=5), guard={"on_foreign": "stop"}, ends_in=ForeignTraffic
    )
    assert what in str(ended.error)


def test_lost_and_late_readings_are_nobodys(servo_bench: BenchRunner) -> None:
    bad_day = {
        "loss": [{"probability": 0.2, "direction": "drive_to_host"}],
        "delay": [{"delay_min_us": 0, "delay_max_us": 4500, "direction": "drive_to_host"}],
    }
    seen = servo_bench(BENCH, QUIET, faults=bad_day)
    assert others(seen) == {}


def test_an_emcy_that_ends_nothing_is_an_event_at_its_frame(servo_bench: BenchRunner) -> None:
    node = ForeignNode(Frame(0x081, bytes.fromhex("1042080000000000")), AT_S, times=5)
    mark = ForeignNode(MARK, MARK_S)
    seen = run(servo_bench, node, mark)
    first, last = events(seen, "axis1: EMCY")
    assert "4210h (excess temperature of the device)" in first["text"]
    assert marked(seen, first, mark, node)
    assert last["text"].endswith("5 times in all")


def test_a_node_that_starts_in_mid_run_is_told_or_ends_it(servo_bench: BenchRunner) -> None:
    told = run(servo_bench, ForeignNode(Frame(0x705, b"\0"), AT_S))
    assert others(told) == {"node 5 started": 1}
    ended = run(
        servo_bench, ForeignNode(Frame(0x705, b"\0"), AT_S), guard={"on_boot": "stop"}, ends_in=ForeignTraffic
    )
    assert "node 5 started" in str(ended.error)


def test_a_drive_that_starts_anew_is_told_at_its_frame_and_ends_the_run(servo_bench: BenchRunner) -> None:
    node, mark = ForeignNode(Frame(0x701, b"\0"), AT_S), ForeignNode(MARK, MARK_S)
    seen = run(servo_bench, node, mark, ends_in=DriveInFault)
    (event,) = events(seen, "node 1 started")
    assert marked(seen, event, mark, node)


def test_a_sudden_rise_of_error_frames_is_told_or_ends_the_run(servo_bench: BenchRunner) -> None:
    noise = {"corruption": [{"probability": 0.02, "effect": "error_frame"}]}
    what = "16 and more error frames within a second"
    told = servo_bench(BENCH, QUIET, faults=noise)
    assert others(told)[what] >= 1
    changes = {**QUIET, "guard": {"on_bus_errors": "stop"}}
    ended = servo_bench(BENCH, changes, faults=noise, ends_in=ForeignTraffic)
    assert what in str(ended.error)


def test_two_drives_on_one_id_are_named_before_anything_moves(servo_bench: BenchRunner) -> None:
    ended = run(servo_bench, ends_in=AnswersTwice, copies=True)
    assert "two devices are likely to have the node id 1" in str(ended.error)
    requests = ended.wire.find("601#*", sent=True)
    assert len(requests) < 500
    assert not ended.wire.find("601#2B4060000F00*", sent=True), "it was not enabled"
    assert ended.wire.frames[-1].at < 10 * NS_PER_S


@pytest.mark.servo_bus("hub")
@pytest.mark.xdist_group("real time")
def test_on_a_hub_it_is_the_same(servo_bench: BenchRunner, servo_bus: str) -> None:
    """By the heartbeat of a second master with the bench's own node id, which no drive can tell from it."""
    beat = can.Message(arbitration_id=0x77F, data=b"\x05", is_extended_id=False)
    with HubBus(servo_bus.removeprefix("hub:")) as stranger:
        frames = stranger.send_periodic(beat, 0.02)
        told = servo_bench(ANY_BUS)
        ended = servo_bench(ANY_BUS, {"guard": {"on_foreign": "stop"}}, ends_in=ForeignTraffic)
        frames.stop()
    what = "heartbeat of node 127 (77Fh) that the bench did not send"
    assert others(told)[what] > 20
    assert [*others(told)] == [what], "nothing else"
    assert what in str(ended.error)
    with pytest.raises(AssertionError, match="never in 'operation enabled'"):
        ended.assert_reached(State.OPERATION_ENABLED)
