"""A drive is put back as its journal found it: in which order, what is left alone, and what is said."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtCommand, NmtState
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.errors import BadInput, NoAnswer, PeerFault
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.restoring.journal import (
    DriveMark,
    Journal,
    JournalContents,
    JournalHead,
    ObjectKey,
    ObjectWrite,
    read_journal,
)
from servobench.hil.restoring.restore import Restoration, await_answer, head_of, restore
from servobench.hil.restoring.settings import pdo_of
from servobench.hil.write_lists import RESTORE
from servobench.virtual_bus.frame import Frame
from tests.scenario.foreign_node import put_on_the_bus

NODE: Final = 7
MARK: Final = DriveMark(1, 2, 3)
AT_REST: Final = {(0x6041, 0): b"\x40\x00", (0x6064, 0): b"\0\0\0\0"}
"""Switch on disabled, and it stands."""
ABORT: Final = 0x80
NO_OBJECT: Final = bytes.fromhex("80 00000206")
READ_ONLY: Final = bytes.fromhex("80 02000106")
Objects = dict[tuple[int, int], bytes]


class Node:
    """A node on a simulated bus that has ``objects`` of up to four bytes; what it was told, in order."""

    def __init__(self, objects: Mapping[tuple[int, int], bytes], kept: frozenset[int] = frozenset()) -> None:
        """``kept``: indices that refuse a write."""
        self.objects = {**AT_REST, **objects}
        self.kept = kept
        self.told: list[str] = []
        self.silent_until = Instant(-1)
        self.state: NmtState | None = None
        """What its heartbeat tells, if it has one."""
        self.wake_at: Instant | None = Instant(0)

    def start(self, now: Instant) -> Sequence[Frame]:
        del now
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = None if self.state is None else Instant(now + 100 * NS_PER_MS)
        return () if self.state is None else (Frame(0x700 + NODE, bytes([self.state])),)

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        if frame.can_id == 0:
            assert frame.data[1] == NODE
            self.told.append(NmtCommand(frame.data[0]).name)
        if frame.can_id != 0x600 + NODE or frame.data[0] == ABORT or now <= self.silent_until:
            return ()
        key = int.from_bytes(frame.data[1:3], "little"), frame.data[3]
        if frame.data[0] == 0x40:
            held = self.objects.get(key)
            answer = NO_OBJECT if held is None else bytes([0x43 | 4 - len(held) << 2]) + held
        else:
            written = frame.data[4 : 8 - (frame.data[0] >> 2 & 3)]
            self.told.append(f"{key[0]:04X}:{key[1]} {written.hex()}")
            answer = READ_ONLY if key[0] in self.kept else b"\x60"
            self.objects |= {} if key[0] in self.kept else {key: written}
        return (Frame(0x580 + NODE, answer[:1] + frame.data[1:4] + answer[1:].ljust(4, b"\0")),)


@contextmanager
def on_a_bus(node: Node) -> Iterator[CanopenNetwork]:
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 0), []) as world:
        put_on_the_bus(world, node)
        yield CanopenNetwork(world.link, world.clock, 126, writes=RESTORE)


def now_ms(network: CanopenNetwork) -> float:
    return network.clock.now() / NS_PER_MS


def put_back(
    node: Node,
    *writes: tuple[int, int, str],
    nmt: int | None = None,
    errors: int | None = None,
) -> tuple[Restoration, list[str]]:
    """What came of it, and what the node was told once it was at rest. ``writes``: object and old value."""
    changes = [ObjectWrite(ObjectKey(index, sub), bytes.fromhex(old), b"") for index, sub, old in writes]
    contents = JournalContents(JournalHead("hub:x", NODE, MARK, nmt, errors), changes)
    said: list[str] = []
    with on_a_bus(node) as network:
        result = restore(network, contents, said.append)
        took_ms = now_ms(network)
        network.pump(network.deadline_after(Duration(NS_PER_MS)))  # the last command is on its way
    assert said == ["bringing the drive to rest"]
    assert node.told[:2] == ["6040:0 0000", "ENTER_PRE_OPERATIONAL"]
    assert took_ms == pytest.approx(3 * 20 + 20, abs=10.0), "three looks at rest, and a while for NMT"
    return result, node.told[2:]


def test_what_was_changed_last_goes_back_first_and_what_is_as_it_was_is_not_written() -> None:
    node = Node(
        {(0x6072, 0): b"\1\0", (0x1016, 1): b"\2\0\0\0", (0x605A, 0): b"\6\0", (0x1017, 0): b"\x32\0"}
    )
    result, told = put_back(
        node, (0x1016, 1, "00000000"), (0x605A, 0, "0600"), (0x6072, 0, "e803"), (0x1017, 0, "0000")
    )
    assert told == ["1017:0 0000", "6072:0 e803", "1016:1 00000000"]
    assert result == Restoration(objects=4, written=3, failures=[])
    assert result.complete


def test_of_several_changes_the_first_old_value_counts() -> None:
    node = Node({(0x6072, 0): b"\5\0"})
    result, told = put_back(node, (0x6072, 0, "0100"), (0x6072, 0, "0200"))
    assert told == ["6072:0 0100"]
    assert (result.objects, result.written) == (1, 1)


def test_what_is_not_as_it_was_at_the_end_is_told() -> None:
    node = Node({(0x6072, 0): b"\5\0"}, kept=frozenset({0x6072}))
    result, _ = put_back(node, (0x6072, 0, "0100"), (0x6099, 2, "10000000"))
    assert result.failures == [
        "6072:00 holds 0500 instead of 0100",
    ]
    assert node.objects[0x6099, 2] == b"\x10\0\0\0", "what was not there takes the write"
    assert not result.complete


def test_what_cannot_be_read_is_told() -> None:
    result, told = put_back(Node({}, kept=frozenset({0x6099})), (0x6099, 2, "10000000"))
    assert told == ["6099:2 10000000"]
    assert result == Restoration(1, 1, ["6099:02 cannot be read instead of 10000000"])


RPDO: Final = {
    (0x1400, 1): bytes.fromhex("07020000"),
    (0x1400, 2): b"\x01",
    (0x1400, 5): b"\x64\0",
    (0x1600, 0): b"\x02",
    (0x1600, 1): bytes.fromhex("10004060"),
    (0x1600, 2): bytes.fromhex("10007160"),
}


def test_a_pdo_is_off_while_it_is_put_back_and_its_count_comes_after_its_objects() -> None:
    """CiA 301 7.5.2.36: COB-ID not valid, count 0, objects, count, and the COB-ID last."""
    result, told = put_back(
        Node(RPDO),
        (0x1400, 1, "07020080"),
        (0x1400, 2, "ff"),
        (0x1600, 0, "01"),
        (0x1600, 2, "10004160"),
        (0x1400, 5, "6400"),
    )
    assert told == [
        "1400:1 07020080",
        "1600:0 00",
        "1600:2 10004160",
        "1600:0 01",
        "1400:2 ff",
    ]
    assert result == Restoration(objects=5, written=3)


def test_one_that_was_on_is_switched_on_again_though_its_identifier_was_not_changed() -> None:
    result, told = put_back(Node(RPDO), (0x1400, 2, "ff"))
    assert told == ["1400:1 07020080", "1400:2 ff", "1400:1 07020000"]
    assert result == Restoration(objects=1, written=2)


def test_a_count_that_was_not_changed_is_the_one_that_is_there() -> None:
    _, told = put_back(Node(RPDO), (0x1600, 1, "08006060"))
    assert told == [
        "1400:1 07020080",
        "1600:0 00",
        "1600:1 08006060",
        "1600:0 02",
        "1400:1 07020000",
    ]


def test_all_that_changed_are_off_before_any_is_put_back() -> None:
    both = {**RPDO, (0x1A00, 0): b"\0", (0x1800, 1): bytes.fromhex("87010080"), (0x1800, 2): b"\x01"}
    _, told = put_back(
        Node(both), (0x1800, 2, "0a"), (0x1800, 1, "87010000"), (0x1400, 2, "ff"), (0x6072, 0, "0100")
    )
    assert told == [
        "1400:1 07020080",  # that of 1800h is off already
        "1400:2 ff",
        "1800:2 0a",
        "1400:1 07020000",
        "1800:1 87010000",
        "6072:0 0100",
    ]


def test_a_pdo_that_is_as_it_was_is_left_alone() -> None:
    result, told = put_back(Node(RPDO), (0x1400, 1, "07020000"), (0x1600, 2, "10007160"))
    assert told == []
    assert result == Restoration(objects=2)


@pytest.mark.parametrize(
    ("index", "pdo"),
    [
        *((0x13FF, None), (0x1400, 0x1400), (0x15FF, 0x15FF), (0x1603, 0x1403), (0x17FF, 0x15FF)),
        *((0x1800, 0x1800), (0x1A02, 0x1802), (0x1BFF, 0x19FF), (0x1C00, None), (0x6072, None)),
    ],
)
def test_the_objects_of_a_pdo_are_known_by_their_index(index: int, pdo: int | None) -> None:
    assert pdo_of(index) == pdo


@pytest.mark.parametrize(
    ("nmt", "told"),
    [
        (5, ["START"]),
        (127, ["ENTER_PRE_OPERATIONAL"]),
        (4, ["STOP"]),
        (0, []),
        (None, []),
    ],
)
def test_at_last_it_is_in_the_state_in_which_it_was_found(nmt: int | None, told: list[str]) -> None:
    assert put_back(Node({}), nmt=nmt)[1] == told


@pytest.mark.parametrize(
    ("before", "now", "told"),
    [
        (0, b"\x02", ["1003:0 00"]),
        (0, b"\x00", []),
        (0, None, []),
        (1, b"\x02", []),
        (None, b"\x02", []),
    ],
)
def test_a_history_that_was_empty_is_cleared(before: int | None, now: bytes | None, told: list[str]) -> None:
    assert put_back(Node({} if now is None else {(0x1003, 0): now}), errors=before)[1] == told


def test_one_that_still_turns_keeps_its_settings() -> None:
    node = Node({(0x6041, 0): b"\x27\0", (0x6072, 0): b"\5\0"})
    contents = JournalContents(
        JournalHead("hub:x", NODE, MARK, 5, 0), [ObjectWrite(ObjectKey(0x6072, 0), b"\1\0", b"")]
    )
    with on_a_bus(node) as network, pytest.raises(PeerFault, match="was not brought to rest"):
        restore(network, contents)
    assert set(node.told) == {"6040:0 0200"}, "nothing but quick stops"


IDENTITY: Final = Identity("a drive", 1, 2, 9, 3, 0x20192)


@pytest.mark.parametrize(
    ("objects", "state", "nmt", "errors", "took_ms"),
    [
        ({(0x1017, 0): b"\x64\0", (0x1003, 0): b"\x02"}, NmtState.OPERATIONAL, 5, 2, 250.0),
        ({(0x1017, 0): b"\x64\0"}, None, None, None, 250.0),
        ({(0x1017, 0): b"\0\0", (0x1003, 0): b"\0"}, NmtState.OPERATIONAL, None, 0, 0.0),
        ({}, NmtState.STOPPED, None, None, 0.0),
    ],
)
def test_a_drive_s_head_waits_for_its_heartbeat(
    objects: Objects, state: NmtState | None, nmt: int | None, errors: int | None, took_ms: float
) -> None:
    node = Node(objects)
    node.state = state
    with on_a_bus(node) as network:
        head = head_of(RemoteObjects(network, NODE), "hub:x", 500_000, IDENTITY)
        assert now_ms(network) == pytest.approx(took_ms, abs=2.0)
    assert head == JournalHead("hub:x", NODE, MARK, nmt, errors, 500_000)


@pytest.mark.parametrize(("silent_ms", "took_ms"), [(-1, 1.0), (250, 302.0), (299, 302.0)])
def test_an_answer_is_awaited_until_it_comes(silent_ms: int, took_ms: float) -> None:
    node = Node({(0x1000, 0): b"\x92\1\2\0"})
    node.silent_until = Instant(silent_ms * NS_PER_MS)
    with on_a_bus(node) as network:
        await_answer(network, NODE, Duration(400 * NS_PER_MS))
        assert silent_ms < now_ms(network) <= took_ms


def test_an_answer_is_not_awaited_beyond_its_limit() -> None:
    node = Node({})
    node.silent_until = Instant(1 << 60)
    with on_a_bus(node) as network:
        with pytest.raises(NoAnswer):
            await_answer(network, NODE, Duration(400 * NS_PER_MS))
        assert now_ms(network) == pytest.approx(400.0, abs=2.0)


# ---- journals -----------------------------------------------------------------------------------------

HEAD: Final = JournalHead("hub:x", NODE, MARK, 127, 0, 250_000)
GOOD: Final = (
    '{"journal": 1, "bus": "hub:x", "node": 7, "vendor": 1, "product": 2, "serial": 3, "nmt": 127}\n'
)


def test_a_head_says_whose_journal_it_is(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "deep" / "er" / "j.jsonl", HEAD)
    journal.close()
    assert (tmp_path / "deep" / "er" / "j.jsonl").read_text() == (
        '{"journal": 1, "bus": "hub:x", "bitrate_bit_s": 250000, "node": 7, "vendor": 1, "product": 2, '
        '"serial": 3, "nmt": 127, "errors": 0}\n'
    )
    assert read_journal(journal.path) == JournalContents(HEAD)


@pytest.mark.parametrize(
    ("text", "key", "value", "expected"),
    [
        ('{"journal": 2}\n', "journal", 2, "version 1"),
        (GOOD.replace('"node": 7', '"node": 128'), "node", 128, "1 to 127"),
        (GOOD.replace('"node"', '"bitrate_bit_s": -5, "node"'), "bitrate_bit_s", -5, "10000 to 4294967295"),
        ('{"object": "6072:00"}\n', "line 1", {"object": "6072:00"}, "the head of a journal"),
        (GOOD + "[]\n", "line 2", "[]\n", "a line of a journal"),
        (GOOD + '{"old": ""}\n', "line 2", {"old": ""}, "object, old and new"),
        (
            GOOD + '{"restored": 1}\n{"object": "6072:00", "old": "0", "new": ""}\n',
            "line 3",
            {"object": "6072:00", "old": "0", "new": ""},
            "object, old and new",
        ),
    ],
)
def test_a_line_that_is_none_of_a_journal_is_told_with_its_number(
    tmp_path: Path, text: str, key: str, value: Any, expected: str
) -> None:
    path = tmp_path / "j.jsonl"
    path.write_text(text)
    with pytest.raises(BadInput) as caught:
        read_journal(path)
    error = caught.value
    assert (error.source, error.key, error.value, error.expected) == (str(path), key, value, expected)


def test_a_journal_that_waits_names_the_command_that_ends_the_waiting(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    path.write_text(GOOD + '{"object": "6072:00", "old": "01", "new": "02"}\n')
    with pytest.raises(BadInput) as caught:
        Journal(path, HEAD)
    error = caught.value
    assert (error.source, error.value) == ("--out", str(tmp_path))
    assert error.expected == "a folder without a journal that waits to be put back"
    assert error.remedy == f"hil restore {path}"
    path.write_text(GOOD)
    Journal(path, HEAD).close()
