"""The guard of a bus, watch by watch: what is told, what is counted, and what ends a run."""

from collections.abc import Callable, Collection, Mapping
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt import Emergency
from servobench.drivers.canopen.pdo import EVERY_SYNC, PdoDirection, PdoEntry, PdoMap
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.configuration.config import Foreign, Guard
from servobench.hil.execution.bus_guard import OBJECTS_TOLD, BusGuard, ForeignTraffic
from servobench.hil.loop.syncs import SyncLog
from tests.ports import kept_rows

MADE_AT: Final = Instant(1_000_000)
AT: Final = Instant(5_000)
PERIOD: Final = Duration(NS_PER_MS)
RPDO: Final = PdoMap(PdoDirection.RECEIVE, 1, 0x203, (PdoEntry(0x6071, 0, "h"),))


def tpdo(transmission_type: int, cob_id: int = 0x183) -> PdoMap:
    return PdoMap(PdoDirection.TRANSMIT, 1, cob_id, (PdoEntry(0x606C, 0, "i"),), transmission_type)


class Bus:
    """A segment with drive 3, whose frames the test makes up."""

    def __init__(
        self,
        *tpdos: PdoMap,
        rules: Mapping[str, Any],
        configured: bool = True,
        own_sync: bool = True,
        repeated: Collection[Foreign] = (),
    ) -> None:
        self.told: list[tuple[int, str, str]] = []
        self.errors = 0
        self.handlers: dict[int, Callable[[bytes, Instant], object]] = {}
        self.listeners: list[Callable[[Emergency], None]] = []
        self.network = SimpleNamespace(
            node_id=127,
            frame_pump=SimpleNamespace(overhear=self.handlers.__setitem__),
            clock=SimpleNamespace(now=lambda: MADE_AT),
            on_emergency=self.listeners.append,
            on_surplus_answer=None,
        )
        self.taken: dict[int, list[tuple[bytes, Instant]]] = {pdo.cob_id: [] for pdo in tpdos}
        self.number = 0
        self.syncs = SyncLog(Duration(0), PERIOD, EchoBasis.NONE)
        plan = SimpleNamespace(rpdos=(RPDO,), tpdos=tpdos)
        self.drive = drive = SimpleNamespace(
            node_id=3,
            name="axis1",
            network=self.network,
            plan=plan if configured else None,
            assembler=SimpleNamespace(keep_frames=self.taken.__getitem__, take_frames=self.take_frames),
            control=SimpleNamespace(make=(0, "")),
        )
        stranger = SimpleNamespace(node_id=9, network=None)
        self.guard = BusGuard(
            {None: cast(CanopenNetwork, self.network)},
            [cast(ServoDrive, drive), cast(ServoDrive, stranger)],
            Guard.model_validate(rules),
            lambda at, level, text: self.told.append((at, level, text)),
            lambda: self.errors,
            own_sync=own_sync,
            repeated=repeated,
        )

    def arm(self, syncs: bool = True) -> None:
        self.guard.arm({None: self.syncs} if syncs else {}, PERIOD)

    def take_frames(self, cob_id: int) -> bytes:
        taken, self.taken[cob_id] = self.taken[cob_id], []
        return kept_rows(taken)

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
            "SDO read from node 3 (603h) that the bench did not send",
            "data 40 41 60 00 00 00 00 00",
        ),
        (
            0x603,
            "2b 72 60 01 00 00 00 00",
            "SDO write of 6072h:01 to node 3 (603h) that the bench did not send",
            "data 2B 72 60 01 00 00 00 00",
        ),
        (
            0x603,
            "c0 72 60 00 02 00 00 00",
            "SDO write of 6072h:00 to node 3 (603h) that the bench did not send",
            "data C0 72 60 00 02 00 00 00",
        ),
        (
            0x603,
            "80 72 60 00 00 00 00 08",
            "SDO request to node 3 (603h) that the bench did not send",
            "data 80 72 60 00 00 00 00 08",
        ),
        (
            0x603,
            "23 16 10 01 00 00 00 00",
            "1016h of node 3 changed by another: it may no longer watch the bench",
            "data 23 16 10 01 00 00 00 00",
        ),
        # a read of 1016h, and a frame that is too short to write anything
        (
            0x603,
            "40 16 10 01 00 00 00 00",
            "SDO read from node 3 (603h) that the bench did not send",
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
    assert bus.told == [(AT, "INFO" if "read" in what else "WARN", f"{what}: {detail}")]
    assert bus.guard.counts == {what: 2}
    bus.hear(0x77E, "00")
    bus.guard.end(Instant(9_000))
    assert bus.told.pop(1)[2].startswith("node 126 started"), "seen once, it is not told again"
    assert bus.told[1:] == [(9_000, "WARN", f"{what}: 2 times in all")]


def test_commands_of_others_are_told_by_their_rpdo() -> None:
    bus = Bus(rules=ALL_TOLD)
    bus.arm()
    bus.hear(0x203, "ff 7f")
    ((_, _, text),) = bus.told
    assert text.endswith("(203h) that the bench did not send: data FF 7F")


def test_what_belongs_to_the_bus_is_not_told() -> None:
    bus = Bus(rules=ALL_TOLD, own_sync=False)
    bus.arm()
    assert 0x080 not in bus.handlers, "somebody else makes the SYNCs"
    assert 0x609 not in bus.handlers, "node 9 is on another segment"
    for can_id in (0x705, 0x703):
        bus.hear(can_id, "05")
        bus.hear(can_id, "00 00")
    assert bus.told == []
    assert 0x701 in bus.handlers
    assert 0x77E in bus.handlers


def test_a_command_to_another_node_is_of_its_own_master() -> None:
    bus = Bus(rules=ALL_TOLD)
    bus.hear(0x000, "01 05")
    assert bus.told == []
    bus.hear(0x000, "01")
    assert len(bus.told) == 1, "nobody knows whom it is for"


def test_a_drive_that_is_not_configured_yet_may_take_the_pdos_of_its_id() -> None:
    bus = Bus(configured=False, rules=ALL_TOLD)
    bus.hear(0x503, "0f 00")
    (text,) = bus.guard.end(AT)
    assert text == "RPDO4 of node 3 (503h) that the bench did not send: data 0F 00, at -0.001 s"
    bus.drive.plan = SimpleNamespace(rpdos=(RPDO,), tpdos=())
    bus.arm()
    bus.hear(0x503, "0f 00")
    assert list(bus.guard.counts.values()) == [1], "it takes 203h alone now"


# ---- what disturbs a run ------------------------------------------------------------------------------

FRAMES: Final = {
    "nmt": (0x000, "02 00"),
    "sync": (0x080, ""),
    "heartbeat": (0x77F, "05"),
    "sdo_write": (0x603, "2b 72 60 00 00 00 00 00"),
    "sdo_read": (0x603, "40 72 60 00 00 00 00 00"),
    "rpdo": (0x203, "ff 7f"),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_what_is_allowed_is_told_and_neither_disturbs_nor_ends_a_run(kind: str) -> None:
    allowing = Bus(rules={"on_foreign": "stop", "allow": [kind]})
    allowing.hear(*FRAMES[kind])
    ((_, level, _),) = allowing.told
    assert (level, allowing.guard.end(AT)) == ("INFO", ())
    telling = Bus(rules={"allow": [other for other in FRAMES if other != kind]})
    telling.hear(*FRAMES[kind], at=Instant(3_000_000))
    telling.hear(*FRAMES[kind], at=Instant(4_000_000))
    (what,) = telling.guard.counts
    data = FRAMES[kind][1].upper() or "none"
    assert telling.guard.end(AT) == (f"{what}: data {data}, at 0.002 s, 2 times",)
    assert telling.guard.end(AT, Instant(0)) == (f"{what}: data {data}, at 0.003 s, 2 times",)
    ending = Bus(rules={"on_foreign": "stop", "allow": []})
    with pytest.raises(ForeignTraffic):
        ending.hear(*FRAMES[kind])


def test_who_writes_anything_is_told_a_bounded_number_of_times() -> None:
    bus = Bus(rules=ALL_TOLD)
    for index in range(0x2000, 0x2000 + 100):
        bus.hear(0x603, f"2b {index & 255:02x} {index >> 8:02x} 00 00 00 00 00")
    assert len(bus.guard.end(AT)) == OBJECTS_TOLD + 1
    assert sum(bus.guard.counts.values()) == 100


@pytest.mark.parametrize("kind", ["tpdo", "sdo_answer"])
def test_what_faults_make_come_twice_is_nobodys(kind: Foreign) -> None:
    for repeated, found in ((), 1), ((kind,), 0):
        bus = Bus(tpdo(1), rules=ALL_TOLD, repeated=repeated)
        bus.arm()
        if kind == "tpdo":
            attended(bus, 0, 9, 100)
        else:
            cast(Any, bus.network).on_surplus_answer(3, b"C", AT)
        assert (len(bus.guard.counts), len(bus.guard.end(AT))) == (1, found)


@pytest.mark.parametrize(
    ("rule", "can_id", "data"),
    [("on_foreign", 0x000, "01 00"), ("on_foreign", 0x603, "23" + 7 * "00"), ("on_boot", 0x705, "00")],
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
    bus.network.on_surplus_answer(3, b"C", AT)
    what = "node 3 sends more answers than requested: two nodes are likely to have its id"
    assert bus.told == [(AT, "WARN", f"{what}: an SDO answer too many (583h), data 43")]


# ---- more TPDOs than SYNCs ----------------------------------------------------------------------------


def attended(bus: Bus, syncs: int, frames: int, at_ms: int, cob_id: int = 0x183) -> list[str]:
    """What is told of so many more SYNCs and frames, each with data of its own."""
    before, at = len(bus.told), at_ms * NS_PER_MS
    for number in range(syncs):
        bus.syncs.handed(bus.syncs.counted + 1, Instant(at - PERIOD * (syncs - number)))
    for number in range(frames):
        bus.number += 1
        data = bus.number.to_bytes(4, "little")
        bus.taken[cob_id].append((data, Instant(at - PERIOD * (frames - number) + PERIOD // 2)))
    bus.guard.attend(Instant(at))
    return [text for _, _, text in bus.told[before:]]


SURPLUS: Final = "TPDO1 of node 3 (183h): more than the SYNCs ask for"


@pytest.mark.parametrize("every", [1, 4])
def test_as_many_tpdos_as_syncs_are_none_too_many(every: int) -> None:
    """Two may be under way: the phase of one that comes seldom, and one that a SYNC has just asked for."""
    bus = Bus(tpdo(every), rules=ALL_TOLD)
    bus.arm()
    assert attended(bus, 0, 2, 0) == []
    assert attended(bus, 10 * every, 10, 100) == []
    assert attended(bus, 0, 3, 200) == [f"{SURPLUS}: 3 since the last look"]
    assert attended(bus, every, 2, 300) == []
    assert bus.guard.counts == {SURPLUS: 4}


def test_frames_before_it_is_armed_and_on_change_are_not_counted() -> None:
    bus = Bus(tpdo(1), tpdo(254, 0x283), rules=ALL_TOLD)
    assert attended(bus, 100, 0, 0) == []
    bus.arm()
    assert attended(bus, 0, 500, 10, 0x283) == []
    assert attended(bus, 0, 3, 100) == [f"{SURPLUS}: 1 since the last look"]
    bus.arm(syncs=False)
    assert attended(bus, 0, 30, 300) == [], "of a segment whose SYNCs are not known"


def test_it_looks_ten_times_a_second_and_once_more_at_the_end() -> None:
    bus = Bus(tpdo(EVERY_SYNC), rules=ALL_TOLD)
    bus.arm()
    assert attended(bus, 0, 0, 7) == []
    assert attended(bus, 0, 5, 70) == []
    assert attended(bus, 0, 0, 71) == [f"{SURPLUS}: 3 since the last look"]
    attended(bus, 0, 4, 80)
    (told,) = bus.guard.end(Instant(90 * NS_PER_MS))
    assert told.endswith("7 times")


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
    bus.taken[0x183] = [(bytes([number]), AT) for number in range(9)]
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
