"""The guard of a bus, watch by watch: what is told, what is counted, and what ends a run."""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from drivers.canopen.network import CanopenNetwork
from drivers.canopen.nmt import Emergency
from drivers.canopen.pdo import EVERY_SYNC, PdoDirection, PdoEntry, PdoMap
from drivers.cia402.servo import ServoDrive
from drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from hil.configuration.config import Guard
from hil.execution.bus_guard import BusGuard, ForeignTraffic
from hil.loop.syncs import SyncLog

AT: Final = Instant(5_000)
RPDO: Final = PdoMap(PdoDirection.RECEIVE, 1, 0x203, (PdoEntry(0x6071, 0, "h"),))


def tpdo(transmission_type: int, cob_id: int = 0x183) -> PdoMap:
    return PdoMap(PdoDirection.TRANSMIT, 1, cob_id, (PdoEntry(0x606C, 0, "i"),), transmission_type)


class Bus:
    """A segment with drive 3, whose frames the test makes up."""

    def __init__(self, *tpdos: PdoMap, rules: Mapping[str, str], configured: bool = True) -> None:
        self.told: list[tuple[int, str, str]] = []
        self.errors = 0
        self.handlers: dict[int, Callable[[bytes, Instant], object]] = {}
        self.listeners: list[Callable[[Emergency], None]] = []
        self.network = SimpleNamespace(
            node_id=127,
            frame_pump=SimpleNamespace(handlers=self.handlers),
            on_emergency=self.listeners.append,
            on_surplus_answer=None,
        )
        self.taken = dict.fromkeys([pdo.cob_id for pdo in tpdos], 0)
        self.syncs = SimpleNamespace(counted=0)
        drive = SimpleNamespace(
            node_id=3,
            name="axis1",
            network=self.network,
            plan=SimpleNamespace(rpdos=(RPDO,), tpdos=tpdos) if configured else None,
            assembler=SimpleNamespace(frames_taken=self.taken.__getitem__),
            control=SimpleNamespace(make=(0, "")),
        )
        stranger = SimpleNamespace(node_id=9, network=None)
        self.guard = BusGuard(
            {None: cast(CanopenNetwork, self.network)},
            [cast(ServoDrive, drive), cast(ServoDrive, stranger)],
            Guard.model_validate(rules),
            lambda at, level, text: self.told.append((at, level, text)),
            lambda: self.errors,
        )

    def arm(self, own_sync: bool = True, syncs: bool = True) -> None:
        logs: Any = {None: cast(SyncLog, self.syncs)} if syncs else {}
        self.guard.arm(logs, own_sync)

    def hear(self, can_id: int, data: str = "", at: Instant = AT) -> None:
        self.handlers[can_id](bytes.fromhex(data), at)


ALL_TOLD: Final = {"on_foreign": "tell", "on_boot": "tell", "on_bus_errors": "tell"}


@pytest.mark.parametrize(
    ("can_id", "data", "what", "detail"),
    [
        (0x000, "01 00", "NMT command (000h) that the bench did not send", "data 01 00"),
        (0x080, "", "SYNC (080h) that the bench did not send", "data none"),
        (0x77F, "05", "heartbeat of node 127 (77Fh) that the bench did not send", "data 05"),
        (
            0x603,
            "40 41 60 00 00 00 00 00",
            "SDO request to node 3 (603h) that the bench did not send",
            "data 40 41 60 00 00 00 00 00",
        ),
        (
            0x603,
            "2b 72 60 01 00 00 00 00",
            "SDO request to node 3 (603h) that the bench did not send",
            "writes 6072h:01, data 2B 72 60 01 00 00 00 00",
        ),
        (
            0x603,
            "23 16 10 01 00 00 00 00",
            "1016h of node 3 changed by another: it may watch the bench no more",
            "writes 1016h:01, data 23 16 10 01 00 00 00 00",
        ),
        # a read of 1016h, and a frame that is too short to write anything
        (
            0x603,
            "40 16 10 01 00 00 00 00",
            "SDO request to node 3 (603h) that the bench did not send",
            "data 40 16 10 01 00 00 00 00",
        ),
        (
            0x603,
            "23 16 10 01",
            "SDO request to node 3 (603h) that the bench did not send",
            "data 23 16 10 01",
        ),
        (0x705, "00", "node 5 started", "a boot-up message"),
        (0x703, "00", "node 3 started", "a boot-up message"),
    ],
)
def test_what_the_bench_did_not_send_is_told_once_and_counted(
    can_id: int, data: str, what: str, detail: str
) -> None:
    bus = Bus(rules=ALL_TOLD)
    bus.arm()
    bus.hear(can_id, data)
    bus.hear(can_id, data, Instant(AT + 1))
    assert bus.told == [(AT, "WARN", f"{what}: {detail}")]
    assert bus.guard.counts == {what: 2}
    bus.guard.end(Instant(9_000))
    assert bus.told[1:] == [(9_000, "WARN", f"{what}: 2 times in all")]


def test_what_was_seen_once_is_not_told_again() -> None:
    bus = Bus(rules=ALL_TOLD)
    bus.arm()
    bus.hear(0x705, "00")
    bus.guard.end(Instant(9_000))
    assert len(bus.told) == 1


def test_commands_of_others_are_told_by_their_rpdo() -> None:
    bus = Bus(rules=ALL_TOLD)
    bus.arm()
    bus.hear(0x203, "ff 7f")
    ((_, _, text),) = bus.told
    assert text.endswith("(203h) that the bench did not send: data FF 7F")


def test_what_belongs_to_the_bus_is_not_told() -> None:
    bus = Bus(rules=ALL_TOLD)
    bus.arm(own_sync=False)
    assert 0x080 not in bus.handlers, "somebody else makes the SYNCs"
    assert 0x609 not in bus.handlers, "node 9 is on another segment"
    for can_id in (0x705, 0x703):
        bus.hear(can_id, "05")
        bus.hear(can_id, "00 00")
    assert bus.told == []
    assert 0x701 in bus.handlers
    assert 0x77E in bus.handlers
    unconfigured = Bus(configured=False, rules=ALL_TOLD)
    unconfigured.arm()
    assert 0x203 not in unconfigured.handlers


def test_the_guard_hears_after_whoever_listens_and_once_however_often_it_is_armed() -> None:
    bus, order = Bus(rules=ALL_TOLD), list[str]()
    bus.handlers[0x705] = lambda data, at: order.append(f"first {len(bus.told)}")
    bus.arm()
    bus.arm()
    bus.hear(0x705, "00")
    assert order == ["first 0"]
    assert bus.guard.counts == {"node 5 started": 1}


@pytest.mark.parametrize(
    ("rule", "can_id", "data"),
    [("on_foreign", 0x000, "01 00"), ("on_foreign", 0x603, "40" + 7 * "00"), ("on_boot", 0x705, "00")],
)
def test_a_rule_that_says_stop_ends_the_run_once(rule: str, can_id: int, data: str) -> None:
    bus = Bus(rules=ALL_TOLD | {rule: "stop"})
    bus.arm()
    with pytest.raises(ForeignTraffic) as caught:
        bus.hear(can_id, data)
    (what,) = bus.guard.counts
    detail = bus.told[0][2].removeprefix(f"{what}: ")
    text = ForeignTraffic(what, detail, "find who sends it (hil scan), or set the rule in [guard]")
    assert str(caught.value) == str(text)
    bus.hear(can_id, data)
    assert bus.guard.counts == {what: 2}
    bus.arm()
    bus.guard.calm()
    bus.hear(can_id, data)
    assert bus.guard.counts == {what: 3}, "after the run all is only told"


def test_an_answer_that_nobody_asked_for_has_two_nodes() -> None:
    bus = Bus(rules=ALL_TOLD)
    bus.arm()
    assert bus.network.on_surplus_answer is not None
    bus.network.on_surplus_answer(3, AT)
    what = "node 3 answers more often than it is asked: two nodes are likely to have its id"
    assert bus.told == [(AT, "WARN", f"{what}: an SDO answer too many")]


# ---- more TPDOs than SYNCs ----------------------------------------------------------------------------


def attended(bus: Bus, syncs: int, frames: int, at_ms: int, cob_id: int = 0x183) -> list[str]:
    """What is told of so many more SYNCs and frames."""
    before = len(bus.told)
    bus.syncs.counted += syncs
    bus.taken[cob_id] += frames
    bus.guard.attend(Instant(at_ms * NS_PER_MS))
    return [text for _, _, text in bus.told[before:]]


SURPLUS: Final = "TPDO1 of node 3 (183h): more than the SYNCs ask for"


@pytest.mark.parametrize("every", [1, 4])
def test_as_many_tpdos_as_syncs_are_none_too_many(every: int) -> None:
    """Two may be under way: the phase of one that comes seldom, and one that a SYNC has just asked for."""
    bus = Bus(tpdo(every), rules=ALL_TOLD)
    bus.arm()
    assert attended(bus, 0, 2, 0) == []
    assert attended(bus, 10 * every, 10, 100) == []
    assert attended(bus, 0, 3, 200) == [f"{SURPLUS}: 3 within the last 0.1 s"]
    assert attended(bus, every, 2, 300) == []
    assert bus.guard.counts == {SURPLUS: 4}


def test_frames_before_it_is_armed_and_on_change_are_not_counted() -> None:
    bus = Bus(tpdo(1), tpdo(254, 0x283), rules=ALL_TOLD)
    bus.syncs.counted, bus.taken[0x183] = 1000, 2000
    bus.arm()
    assert attended(bus, 0, 500, 0, 0x283) == []
    assert attended(bus, 0, 3, 100) == [f"{SURPLUS}: 1 within the last 0.1 s"]
    bus.guard.calm()
    assert attended(bus, 0, 30, 200) == []
    bus.arm(syncs=False)
    assert attended(bus, 0, 30, 300) == [], "of a segment whose SYNCs are not known"


def test_it_looks_ten_times_a_second() -> None:
    bus = Bus(tpdo(EVERY_SYNC), rules=ALL_TOLD)
    bus.arm()
    assert attended(bus, 0, 0, 7) == []
    assert attended(bus, 0, 5, 106) == []
    assert attended(bus, 0, 0, 107) == [f"{SURPLUS}: 3 within the last 0.1 s"]


# ---- errors -------------------------------------------------------------------------------------------

ERRORS: Final = "16 and more error frames within a second"


def errors_told(bus: Bus, *looks: tuple[int, int]) -> list[str]:
    """``looks``: at which instant, ms, how many there were so far."""
    for at_ms, count in looks:
        bus.errors = count
        bus.guard.attend(Instant(at_ms * NS_PER_MS))
    return [text for _, _, text in bus.told]


@pytest.mark.parametrize(
    ("looks", "said"),
    [
        ([(0, 0), (100, 15)], []),
        ([(0, 0), (100, 16)], [f"{ERRORS}: 16 now, 16 in all"]),
        ([(0, 0), (100, 8), (900, 16)], [f"{ERRORS}: 16 now, 16 in all"]),
        # what is older than a second counts no more
        ([(at, at // 100) for at in range(0, 3000, 100)], []),
        ([(at, 2 * at // 100) for at in range(0, 801, 100)], [f"{ERRORS}: 16 now, 16 in all"]),
        # and what came while nobody looked for longer than a second
        ([(0, 0), (1_101, 100)], []),
        ([(0, 0), (1_100, 100)], [f"{ERRORS}: 100 now, 100 in all"]),
    ],
)
def test_errors_that_come_in_a_second_are_told(looks: list[tuple[int, int]], said: list[str]) -> None:
    assert errors_told(Bus(rules=ALL_TOLD), *looks) == said


def test_errors_before_the_guard_and_those_told_already_begin_anew() -> None:
    bus = Bus(rules=ALL_TOLD)
    assert errors_told(bus, (0, 20), (100, 35)) == [f"{ERRORS}: 20 now, 20 in all"]
    assert bus.guard.counts == {ERRORS: 1}
    errors_told(bus, (200, 36))
    assert bus.guard.counts == {ERRORS: 2}
    stopping = Bus(rules=ALL_TOLD | {"on_bus_errors": "stop"})
    stopping.arm()
    with pytest.raises(ForeignTraffic, match="16 and more error frames"):
        errors_told(stopping, (0, 0), (100, 16))


def test_another_chore_of_the_loop_comes_first() -> None:
    bus, order = Bus(tpdo(1), rules=ALL_TOLD), list[tuple[int, int]]()
    assert bus.guard.attending(None) == bus.guard.attend
    bus.arm()
    bus.taken[0x183] = 9
    both = bus.guard.attending(lambda now: order.append((now, len(bus.told))))
    both(Instant(NS_PER_S))
    assert order == [(NS_PER_S, 0)]
    assert len(bus.told) == 1


# ---- emergencies --------------------------------------------------------------------------------------


def test_emergencies_of_anybody_are_told_with_their_name_and_end_nothing() -> None:
    bus = Bus(rules=dict.fromkeys(ALL_TOLD, "stop"))
    (of_network,) = bus.listeners
    bus.arm()
    bus.hear(0x085, "10 82 11 00 00 00 00 00")
    bus.hear(0x085, "10 82 11 00 00 00 00 00")
    of_network(Emergency(3, 0x7310, 0x21, b"\0" * 5, AT))
    bus.hear(0x085, "10")
    assert 0x083 not in bus.handlers, "the network hears those of its drives"
    assert bus.guard.counts == {"node 5: EMCY 8210h": 2, "axis1: EMCY 7310h": 1}
    first, second = bus.told
    assert first[:2] == (AT, "WARN")
    assert first[2].startswith("node 5: ")
    assert second[2].startswith("axis1: ")
