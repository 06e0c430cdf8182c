"""What a list does not name is not written: no frame leaves, by whatever way it is tried."""

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from canopen.sdo.exceptions import SdoError
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.canopen.cob_ids import SDO_REQUEST
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.sdo import PumpedSdoClient
from servobench.drivers.canopen.write_list import ListedWrite, Product, UnlistedWrite, WriteList
from servobench.drivers.cia402.drive_setup import read_identity
from servobench.drivers.cia402.objects402 import CONTROL, SET_UP, Object, listed
from servobench.drivers.errors import BadInput, PeerFault
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.configuration.drive_file import load_drive_file
from servobench.hil.restoring.journal import (
    DriveMark,
    Journal,
    JournaledNetwork,
    JournalHead,
    ObjectKey,
    read_journal,
)
from servobench.hil.restoring.journal import ObjectWrite as Change
from servobench.hil.write_lists import COMMANDS, RUN, writes_of
from tests.draws import examples_of
from tests.unit.drivers.fake_bus import FakeBus, FakeServo

ROOT = Path(__file__).parents[3]
LIMIT = (0x6072, 0)
SPEED = (0x6080, 0)
LIST = WriteList("a test", (listed(Object.MAX_TORQUE, "limit", "now"),))
OWN = Product(0x1234, 0, "Fake servo with a long name")
"""The fake servo by its own words."""
Rig = tuple[FakeBus, FakeServo, CanopenNetwork]


def rig_with(writes: WriteList | None) -> Rig:
    bus = FakeBus()
    servo = FakeServo(bus)
    link = BusLink(bus, bus, StampSource.MONOTONIC, "fake")
    return (
        bus,
        servo,
        CanopenNetwork(link, bus) if writes is None else CanopenNetwork(link, bus, writes=writes),
    )


@pytest.fixture
def rig() -> Rig:
    return rig_with(LIST)


def initiate(first: int, index: int, sub: int) -> bytes:
    return bytes((first, index & 0xFF, index >> 8, sub, 0, 0, 0, 0))


def by_canopen(network: CanopenNetwork, index: int, sub: int, size: int, *, blocks: bool) -> None:
    client: Any = PumpedSdoClient(network, 1)
    with client.open(index, sub, "wb", size=size, block_transfer=blocks) as file:
        file.write(bytes(size))


WAYS: dict[str, Callable[[CanopenNetwork, int, int], object]] = {
    "expedited": lambda network, index, sub: network.download(1, index, sub, b"\1\0"),
    "segmented": lambda network, index, sub: network.download(1, index, sub, bytes(9)),
    "posted": lambda network, index, sub: network.post_download(1, index, sub, b"\1\0"),
    "typed": lambda network, index, sub: RemoteObjects(network, 1).write(index, sub, "H", 1),
    "a request": lambda network, index, sub: network.send_request(1, initiate(0x2B, index, sub)),
    "canopen's client": lambda network, index, sub: by_canopen(network, index, sub, 2, blocks=False),
}


@pytest.mark.parametrize("way", WAYS)
def test_an_object_off_the_list_is_refused_and_no_frame_leaves(rig: Rig, way: str) -> None:
    bus, _, network = rig
    with pytest.raises(UnlistedWrite) as caught:
        WAYS[way](network, *SPEED)
    assert str(caught.value) == (
        "a test: SDO write: found '6080h:00 of node 1', expected an object on its list; nothing was sent; "
        "hil docs writes has the list of each command"
    )
    assert (caught.value.exit_status, bus.sent) == (2, [])


@pytest.mark.parametrize("way", WAYS)
def test_an_object_on_the_list_is_written(rig: Rig, way: str) -> None:
    bus, servo, network = rig
    servo.silent = True
    with suppress(PeerFault, SdoError):
        WAYS[way](network, *LIMIT)
    assert bus.sent_to(SDO_REQUEST + 1)[0][1:4] == bytes((0x72, 0x60, 0))


def test_blocks_are_not_sent_even_to_a_listed_object(rig: Rig) -> None:
    bus, _, network = rig
    with pytest.raises(ValueError, match="block downloads"):
        by_canopen(network, *LIMIT, 20, blocks=True)
    assert bus.sent == []


def test_a_request_is_no_message_of_canopens(rig: Rig) -> None:
    bus, _, network = rig
    for node in (1, 127):
        with pytest.raises(ValueError, match="SDO requests"):
            network.send_message(SDO_REQUEST + node, initiate(0x2B, *LIMIT))
    assert bus.sent == []


def test_no_other_module_sends_on_an_sdo_channel() -> None:
    sends = re.compile(r"\bsend\w*\(\s*(SDO_REQUEST|0x6)")
    files = [path for room in ("drivers", "hil") for path in (ROOT / room).rglob("*.py")]
    assert len(files) > 300
    sending = [path.name for path in files if sends.search(path.read_text(encoding="utf-8"))]
    assert sending == ["network.py"]


def test_a_network_without_a_list_reads_and_writes_nothing() -> None:
    bus, servo, network = rig_with(None)
    servo.values[LIMIT] = 7
    assert network.upload(1, *LIMIT) == b"\7\0"
    bus.sent.clear()
    with pytest.raises(UnlistedWrite, match="a master without a list of writes"):
        network.download(1, *LIMIT, b"\1\0")
    assert bus.sent == []


@examples_of(100)
@given(index=st.integers(0x1000, 0xFFFF), sub=st.integers(0, 255), first=st.integers(0, 255))
def test_a_frame_leaves_if_it_begins_no_write_or_a_listed_one(index: int, sub: int, first: int) -> None:
    bus, _, network = rig_with(SET_UP)
    with suppress(UnlistedWrite, ValueError):
        network.send_request(1, initiate(first, index, sub))
    begins = 0x20 <= first < 0x40
    blocks = 0xC0 <= first < 0xE0
    named = any(index in write.indices and sub in write.subs for write in SET_UP)
    assert bool(bus.sent) == ((not begins or named) and not blocks)


# ---- objects of makers ------------------------------------------------------------------------------------


def makers(product: Product | None) -> ListedWrite:
    return ListedWrite(range(0x2100, 0x2101), (1,), "Load", "load", "now", product)


@pytest.mark.parametrize("indices", [range(0x2000, 0x2001), range(0x5FFF, 0x6001), range(0x1FFF, 0x2001)])
def test_an_object_of_a_maker_is_listed_for_a_product_alone(indices: range) -> None:
    with pytest.raises(ValueError, match="belongs to the maker of a drive: name the product"):
        ListedWrite(indices, (0,), "made", "why", "when")


@pytest.mark.parametrize(
    ("product", "identified", "taken"),
    [
        (OWN, True, True),
        (OWN, False, False),
        (OWN._replace(vendor=0x1235), True, False),
        (OWN._replace(code=1), True, False),
        (OWN._replace(device_name="Fake servo"), True, False),
    ],
)
def test_it_is_written_once_the_node_has_said_that_it_is_the_product(
    product: Product, identified: bool, taken: bool
) -> None:
    bus, servo, network = rig_with(WriteList("a test", (makers(product),)))
    servo.values[0x1000, 0] = 0x00020192
    if identified:
        read_identity(RemoteObjects(network, 1))
    bus.sent.clear()
    if taken:
        network.download(1, 0x2100, 1, bytes(4))
        assert len(bus.sent) == 1
        return
    with pytest.raises(UnlistedWrite, match=f"expected this object of {product.device_name}"):
        network.download(1, 0x2100, 1, bytes(4))
    assert bus.sent == []


def test_no_command_writes_an_object_of_a_maker_to_a_drive_of_any_make() -> None:
    for command, writes in COMMANDS.items():
        assert all((index, 1) not in writes for index in range(0x2000, 0x6000, 0x80)), command
    assert not writes_of("eds").writes


# ---- lists ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("indices", "subs", "text"),
    [
        (range(0x6040, 0x6041), (0,), "6040h:00"),
        (range(0x1016, 0x1017), tuple(range(1, 128)), "1016h:01-7F"),
        (range(0x1400, 0x1600), (1, 2, 5), "1400h-15FFh:01,02,05"),
    ],
)
def test_objects_in_words(indices: range, subs: tuple[int, ...], text: str) -> None:
    assert ListedWrite(indices, subs, "", "", "").objects == text


def test_inside_a_narrower_list_nothing_else_is_written(rig: Rig) -> None:
    _, _, network = rig
    with network.writes.only(CONTROL), pytest.raises(UnlistedWrite):
        network.download(1, *LIMIT, b"\1\0")
    network.download(1, *LIMIT, b"\1\0")


# ---- files that name objects ------------------------------------------------------------------------------


def test_a_journal_neither_asks_for_nor_notes_what_may_not_be_written(tmp_path: Path) -> None:
    bus = FakeBus()
    FakeServo(bus)
    network = JournaledNetwork(BusLink(bus, bus, StampSource.MONOTONIC, "fake"), bus, CONTROL)
    journal = Journal(tmp_path / "journal.jsonl", JournalHead("fake", 1, DriveMark(1, 2, 3), None))
    with network.writes.only(RUN):
        network.begin_journal(journal)
    noted = journal.path.read_bytes()
    bus.sent.clear()
    with pytest.raises(UnlistedWrite):
        network.download(1, *LIMIT, b"\1\0")
    assert (bus.sent, journal.path.read_bytes()) == ([], noted)
    journal.close()


def test_a_journal_that_names_an_object_that_is_never_written_is_refused(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.jsonl", JournalHead("fake", 1, DriveMark(1, 2, 3), None))
    journal.note(Change(ObjectKey(0x2100, 1), b"\7\0", b"\0\0"))
    journal.close()
    with pytest.raises(BadInput) as caught:
        read_journal(journal.path)
    assert (caught.value.key, caught.value.value) == ("line 2", "2100h:01")
    assert caught.value.expected == "an object that hil commission or hil measure writes (hil docs writes)"


def test_a_drive_file_that_names_an_object_of_the_maker_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "drive.toml"
    text = '[drive]\nnode = 1\nvendor = 1\nproduct = 2\n[[object]]\nindex = {}\nsub = 1\nbytes = "0700"\n'
    path.write_text(text.format("0x2100"))
    with pytest.raises(BadInput) as caught:
        load_drive_file(path)
    assert caught.value.key == "object[0]"
    assert caught.value.expected == "index: an object on the list of hil run (hil docs writes), or none"
    path.write_text(text.format("0x60C2"))
    assert load_drive_file(path).object[0].index == 0x60C2
