"""pcap and pcapng packed here by their drafts: both byte orders, each link type of CAN, damaged files."""

from io import BytesIO
from struct import pack

import pytest

from servobench.hil.reviewing.trace.bus_log import BrokenCapture, OtherPacket, capture_packets
from servobench.hil.reviewing.trace.frame_columns import LogFrame

SECOND = 1_000_000_000
ORDERS = ("<", ">")
SOCKETCAN, COOKED, COOKED_2, UPPER = 227, 113, 276, 252
PIECE_MAX = 1 << 20


def can(word: int, data: bytes = b"", length: int | None = None, flags: int = 0, order: str = ">") -> bytes:
    """struct can_frame and canfd_frame of linux/can.h."""
    return pack(order + "IBBxx", word, len(data) if length is None else length, flags) + data


def pcap(
    *packets: tuple[int, int, bytes], order: str = "<", kind: int = SOCKETCAN, ns: bool = False
) -> bytes:
    """Seconds, their smaller part and content of each packet."""
    head = pack(order + "IHHiIII", 0xA1B23C4D if ns else 0xA1B2C3D4, 2, 4, 0, 0, 65535, kind)
    return head + b"".join(
        pack(order + "IIII", at_s, part, len(data), len(data)) + data for at_s, part, data in packets
    )


def read(content: bytes) -> list[LogFrame | OtherPacket]:
    return list(capture_packets(BytesIO(content)))


def one(data: bytes, kind: int = SOCKETCAN, order: str = "<") -> LogFrame | OtherPacket:
    (packet,) = read(pcap((0, 0, data), kind=kind, order=order))
    return packet


def refusal(content: bytes) -> str:
    with pytest.raises(BrokenCapture) as caught:
        read(content)
    return str(caught.value)


# ---- frames -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "frame"),
    [
        (can(0x123, b"\x11\x22"), LogFrame(1, 0, "", 0x123, b"\x11\x22")),
        (can(0x7FF, bytes(8)), LogFrame(1, 0, "", 0x7FF, bytes(8))),
        (can(0x123), LogFrame(1, 0, "", 0x123, b"")),
        # bits between the 11 of a standard identifier and the flags are none of it
        (can(0x1FFF_F923, b"a"), LogFrame(1, 0, "", 0x123, b"a")),
        (can(0x9ABC_DEF0, b"a"), LogFrame(1, 0, "", 0x1ABC_DEF0, b"a", extended=True)),
        (can(0x8000_0123, b"a"), LogFrame(1, 0, "", 0x123, b"a", extended=True)),
        # a request has a length, and no data
        (can(0x4000_0705, b"", 8), LogFrame(1, 0, "", 0x705, b"", remote=True)),
        (can(0x4000_0705, b"", 1), LogFrame(1, 0, "", 0x705, b"", remote=True)),
        (can(0xC000_1234, b"ab"), LogFrame(1, 0, "", 0x1234, b"", extended=True, remote=True)),
        # of an error frame the identifier is its classes, which need more than 11 bits
        (can(0x2000_2004, bytes(8)), LogFrame(1, 0, "", 0x2004, bytes(8), error=True)),
        (can(0xA000_0004, bytes(8)), LogFrame(1, 0, "", 0x004, bytes(8), error=True)),
        # CAN FD by its flag, or by its length
        (can(0x123, b"a", flags=0x04), LogFrame(1, 0, "", 0x123, b"a", fd=True)),
        (can(0x123, b"a", flags=0x03), LogFrame(1, 0, "", 0x123, b"a")),
        (can(0x123, bytes(9)), LogFrame(1, 0, "", 0x123, bytes(9), fd=True)),
        (can(0x123, bytes(64)), LogFrame(1, 0, "", 0x123, bytes(64), fd=True)),
        # what a capture holds behind the data is padding
        (can(0x123, b"ab" + bytes(6), 2), LogFrame(1, 0, "", 0x123, b"ab")),
    ],
)
def test_a_packet_of_socketcan_is_the_frame_of_the_kernel(data: bytes, frame: LogFrame) -> None:
    assert one(data) == frame
    assert one(data, order=">") == frame


@pytest.mark.parametrize(
    "data",
    [b"", can(0x123)[:-1], can(0x123, b"a", 2), can(0x123, bytes(65)), can(0x4000_0123, b"", 65)],
)
def test_a_packet_that_is_too_short_or_too_long_is_no_frame(data: bytes) -> None:
    assert one(data) == OtherPacket(1)


@pytest.mark.parametrize("kind", [0, 1, 112, 190, 226, 228])
def test_a_link_of_another_network_has_no_frames(kind: int) -> None:
    assert one(can(0x123, b"a"), kind) == OtherPacket(1)


def cooked(protocol: int, packet_type: int, data: bytes, kind: int) -> bytes:
    """LINUX_SLL and LINUX_SLL2: type of packet and protocol in front."""
    if kind == COOKED:
        return pack(">HHH8xH", packet_type, 280, 0, protocol) + data
    return pack(">HHIHBB8x", protocol, 0, 3, 280, packet_type, 0) + data


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("kind", [COOKED, COOKED_2])
@pytest.mark.parametrize(("packet_type", "sent"), [(0, "R"), (1, "R"), (3, "R"), (4, "T"), (5, "R")])
def test_a_cooked_packet_tells_its_direction(order: str, kind: int, packet_type: int, sent: str) -> None:
    data = can(0x8012_3456, b"ab", order=order)
    for protocol in (0x000C, 0x000D):
        packet = cooked(protocol, packet_type, data, kind)
        assert one(packet, kind, order) == LogFrame(1, 0, "", 0x0012_3456, b"ab", extended=True, sent=sent)
    for protocol in (0x000B, 0x000E, 0x010C, 0x0800, 0x0C00):
        assert one(cooked(protocol, packet_type, data, kind), kind, order) == OtherPacket(1)


@pytest.mark.parametrize("kind", [COOKED, COOKED_2, UPPER])
def test_a_packet_cut_off_in_front_of_the_frame_is_none(kind: int) -> None:
    whole = upper(b"can-bigendian", b"") if kind == UPPER else cooked(0x000C, 0, b"", kind)
    for size in range(len(whole) + 1):
        assert one(whole[:size], kind) == OtherPacket(1)


def upper(name: bytes, data: bytes, *tags: tuple[int, bytes]) -> bytes:
    """WIRESHARK_UPPER_PDU: tags, one of them the dissector's name, up to tag 0."""
    parts = [pack(">HH", tag, len(value)) + value for tag, value in (*tags, (12, name))]
    return b"".join(parts) + pack(">HH", 0, 0) + data


@pytest.mark.parametrize("order", ORDERS)
def test_an_upper_packet_is_read_by_the_name_of_its_dissector(order: str) -> None:
    frame = LogFrame(1, 0, "", 0x123, b"ab")
    host, big = can(0x123, b"ab", order=order), can(0x123, b"ab")
    assert one(upper(b"can-hostendian", host), UPPER, order) == frame
    assert one(upper(b"canfd", host), UPPER, order) == frame
    assert one(upper(b"can-bigendian", big), UPPER, order) == frame
    assert one(upper(b"can-bigendian\0\0\0", big, (32, b"abcd"), (13, b"")), UPPER, order) == frame
    assert one(upper(b"http", big), UPPER, order) == OtherPacket(1)
    assert one(upper(b"can-bigendian", big)[4:], UPPER, order) == OtherPacket(1)


# ---- pcap ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(("ns", "unit"), [(False, 1000), (True, 1)])
def test_the_magic_of_pcap_tells_byte_order_and_unit(order: str, ns: bool, unit: int) -> None:
    packets = [(7, 5, can(0x123)), (1 << 31, 999_999, b""), (8, 0, can(0x124))]
    assert read(pcap(*packets, order=order, ns=ns)) == [
        LogFrame(1, 7 * SECOND + 5 * unit, "", 0x123, b""),
        OtherPacket(2),
        LogFrame(3, 8 * SECOND, "", 0x124, b""),
    ]
    assert read(pcap(order=order, ns=ns)) == []


def test_the_upper_half_of_the_link_type_is_none_of_it() -> None:
    """It tells the length of a check sum."""
    assert one(can(0x123), 0x1401_0000 | SOCKETCAN) == LogFrame(1, 0, "", 0x123, b"")


def test_where_a_pcap_is_cut_off_is_told() -> None:
    whole = pcap((0, 0, can(0x123)), (0, 1, can(0x124)))
    head, packet = 24, 24
    for size in range(4, head):
        assert refusal(whole[:size]) == "it ends within its header"
    for size in (*range(head + 1, head + packet), *range(head + packet + 1, len(whole))):
        assert refusal(whole[:size]) == f"it ends within packet {1 if size < head + packet else 2}"
    assert [len(read(whole[:size])) for size in (head, head + packet, len(whole))] == [0, 1, 2]


def test_a_packet_that_no_network_has_is_damage() -> None:
    assert one(bytes(PIECE_MAX), 1) == OtherPacket(1)
    assert refusal(pcap() + pack("<IIII", 0, 0, PIECE_MAX + 1, 0)) == f"packet 1 of {PIECE_MAX + 1} bytes"


# ---- pcapng -------------------------------------------------------------------------------------------


def block(kind: int, body: bytes, order: str = "<") -> bytes:
    body += bytes(-len(body) % 4)
    length = pack(order + "I", 12 + len(body))
    return pack(order + "I", kind) + length + body + length


def section(order: str = "<") -> bytes:
    return block(0x0A0D0D0A, pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)


def options(*given: tuple[int, bytes], order: str = "<") -> bytes:
    return b"".join(
        pack(order + "HH", code, len(value)) + value + bytes(-len(value) % 4) for code, value in given
    )


def interface(*given: tuple[int, bytes], order: str = "<", kind: int = SOCKETCAN) -> bytes:
    return block(1, pack(order + "HHI", kind, 0, 0) + options(*given, order=order), order)


def packet(data: bytes, stamp: int = 0, which: int = 0, order: str = "<", more: bytes = b"") -> bytes:
    head = pack(order + "IIIII", which, stamp >> 32, stamp & 0xFFFF_FFFF, len(data), len(data))
    return block(6, head + data + bytes(-len(data) % 4) + more, order)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("resolution", "stamp", "at_ns"),
    [
        ([], 7_000_001, 7 * SECOND + 1000),  # without: us
        ([(9, b"\x06")], 7_000_001, 7 * SECOND + 1000),
        ([(9, b"\x09")], 5 << 32 | 3, (5 << 32) + 3),
        ([(9, b"\x03")], 7_001, 7 * SECOND + 1_000_000),
        ([(9, b"\x00")], 7, 7 * SECOND),
        ([(9, b"\x8a")], 1024 + 512, 3 * SECOND // 2),  # 2^-10 s
        ([(9, b"\x80")], 7, 7 * SECOND),
        ([(9, b"\x7f")], 10**18, SECOND),  # finer than 10^-18 s there is none
        ([(9, b"")], 7_000_001, 7 * SECOND + 1000),
    ],
)
def test_a_stamp_counts_in_the_unit_of_its_interface(
    order: str, resolution: list[tuple[int, bytes]], stamp: int, at_ns: int
) -> None:
    link = interface((2, b"can7\0"), *resolution, (3, b"of the left axis"), order=order)
    content = section(order) + link + packet(can(0x123, b"abc"), stamp, order=order)
    assert read(content) == [LogFrame(1, at_ns, "can7", 0x123, b"abc")]
    for offset_s, offset in ((1000, pack(order + "q", 1000)), (-2, pack(order + "q", -2)), (0, b"offset")):
        link = interface(*resolution, (14, offset), order=order)
        content = section(order) + link + packet(can(0x123), stamp, order=order)
        assert read(content) == [LogFrame(1, at_ns + offset_s * SECOND, "", 0x123, b"")]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(("flags", "sent"), [(0, ""), (1, "R"), (2, "T"), (3, ""), (0xFFFF_FFF5, "R")])
def test_a_packet_tells_its_direction_in_the_lowest_flags(order: str, flags: int, sent: str) -> None:
    words = pack(order + "I", flags)
    for size in (8, 9, 10, 11):
        for before in ((), ((1, b"a remark"),), ((1, b"odd"),)):
            more = options(*before, (2, words), order=order)
            content = section(order) + interface(order=order)
            content += packet(can(0x123, bytes(size - 8)), order=order, more=more)
            assert read(content) == [LogFrame(1, 0, "", 0x123, bytes(size - 8), sent=sent)]
    for more in (options((2, words[:3]), order=order), options((0, b""), (2, words), order=order)):
        content = section(order) + interface(order=order) + packet(can(0x123), order=order, more=more)
        assert read(content) == [LogFrame(1, 0, "", 0x123, b"")]


def test_each_section_has_interfaces_and_a_byte_order_of_its_own() -> None:
    left, right = (2, b"left"), (2, b"right")
    content = section("<") + interface(left) + interface(right, (9, b"\x09")) + interface(kind=1)
    content += packet(can(1), 1, which=0) + packet(can(2), 2, which=1) + packet(can(3), 3, which=2)
    content += block(5, bytes(12)) + block(4, b"names!!!")  # statistics and names are no packets
    content += section(">") + interface(right, order=">") + packet(can(4), 4, order=">")
    content += block(3, pack(">I", 9) + can(5, b"a"), ">")
    assert read(content) == [
        LogFrame(1, 1000, "left", 1, b""),
        LogFrame(2, 2, "right", 2, b""),
        OtherPacket(3),
        LogFrame(4, 4000, "right", 4, b""),
        LogFrame(5, None, "right", 5, b"a"),
    ]


def test_a_simple_packet_without_an_interface_is_of_no_network() -> None:
    assert read(section() + block(3, pack("<I", 8) + can(1))) == [OtherPacket(1)]


@pytest.mark.parametrize(
    ("tail", "told"),
    [
        (packet(can(1), which=1), "packet 1 contradicts its file"),
        (block(6, pack("<IIIII", 0, 0, 0, 9, 9) + can(1)), "packet 1 contradicts its file"),
        (packet(can(1)) + block(6, bytes(16)), "packet 2 is too short"),
        (block(1, bytes(4)), "an interface description that is too short"),
        (pack("<II", 6, 8), "a block of 8 bytes"),
        (pack("<II", 6, 14), "a block of 14 bytes"),
        (pack("<II", 6, 0), "a block of 0 bytes"),
        (pack("<II", 6, PIECE_MAX + 12), f"a block of {PIECE_MAX + 4} bytes"),
        (pack("<IIII", 0x0A0D0D0A, 12, 0x1A2B3C4D, 0), "a block of 12 bytes"),
    ],
)
def test_a_file_that_contradicts_itself_is_damaged(tail: bytes, told: str) -> None:
    assert refusal(section() + interface() + tail) == told


def test_a_block_may_be_empty_and_a_packet_may_be_all_of_its_block() -> None:
    content = section() + interface() + block(9, b"") + packet(b"")
    assert read(content) == [OtherPacket(1)]


def test_where_a_pcapng_is_cut_off_is_told() -> None:
    parts = [section(), interface(), packet(can(0x123, b"abc"))]
    whole = b"".join(parts)
    ends = {sum(map(len, parts[: number + 1])) for number in range(len(parts))}
    for size in range(4, len(whole) + 1):
        if size in ends:
            assert len(read(whole[:size])) == (size == len(whole))
        else:
            within = "a section header" if 8 <= size < 12 else "a block"
            assert refusal(whole[:size]) == f"it ends within {within}"
