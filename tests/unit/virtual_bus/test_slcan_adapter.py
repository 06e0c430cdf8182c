"""The emulated adapter's firmware, command by command, against the list of the CAN232 manual."""

import pytest

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.drivers.wire.slcan_protocol import BITRATE_CODES, SlcanStatus
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.instruments.slcan_adapter import POLLED_FRAMES_MAX, AcceptanceFilter, SlcanAdapter

CLOSED_ONLY = (b"S6", b"s031C", b"X1", b"W1", b"M00000000", b"mFFFFFFFF", b"Z1")
OPEN_ONLY = (b"C", b"F", b"t1000", b"T000001000", b"r1000", b"R000001000")


class Controller:
    """The CAN side: notes what it is told."""

    def __init__(self) -> None:
        self.opened: tuple[int, bool] | None = None
        self.sent: list[Frame] = []
        self.room = True
        self.own_flags = SlcanStatus(0)

    def open(self, bitrate_bit_s: int, listen_only: bool) -> None:
        self.opened = bitrate_bit_s, listen_only

    def close(self) -> None:
        self.opened = None

    def send(self, frame: Frame) -> bool:
        if self.room:
            self.sent.append(frame)
        return self.room

    def flags(self) -> SlcanStatus:
        return self.own_flags


@pytest.fixture
def controller() -> Controller:
    return Controller()


@pytest.fixture
def adapter(controller: Controller) -> SlcanAdapter:
    return SlcanAdapter(controller)


def ask(adapter: SlcanAdapter, text: bytes) -> bytes:
    return b"".join(adapter.take(text + b"\r"))


@pytest.mark.parametrize(("bitrate", "code"), BITRATE_CODES.items())
def test_bit_rates_of_the_table(
    adapter: SlcanAdapter, controller: Controller, bitrate: int, code: int
) -> None:
    assert ask(adapter, b"S%d" % code) == b"\r"
    assert ask(adapter, b"O") == b"\r"
    assert controller.opened == (bitrate, False)


@pytest.mark.parametrize(("registers", "bitrate"), [(b"s0014", 1_000_000), (b"s031C", 125_000)])
def test_bit_rates_by_timing_registers(
    adapter: SlcanAdapter, controller: Controller, registers: bytes, bitrate: int
) -> None:
    assert ask(adapter, registers) == b"\r"
    ask(adapter, b"O")
    assert controller.opened == (bitrate, False)


def test_commands_outside_of_their_state_are_refused_and_change_nothing(
    adapter: SlcanAdapter, controller: Controller
) -> None:
    for command in OPEN_ONLY:
        assert ask(adapter, command) == b"\a", command
    assert ask(adapter, b"O") == b"\a", "opened without a bit rate"
    ask(adapter, b"S8")
    ask(adapter, b"O")
    for command in (*CLOSED_ONLY, b"O", b"L"):
        assert ask(adapter, command) == b"\a", command
    assert controller.opened == (1_000_000, False)
    assert controller.sent == []


@pytest.mark.parametrize("command", [b"S9", b"S", b"S10", b"s00", b"Q", b"v?", b"M0", b"Z2", b"VV", b"\xff"])
def test_unknown_or_malformed_commands_are_refused(adapter: SlcanAdapter, command: bytes) -> None:
    assert ask(adapter, command) == b"\a"
    assert adapter.refused == 1


def test_version_serial_number_and_an_empty_line(adapter: SlcanAdapter) -> None:
    assert ask(adapter, b"V") == b"V1013\r"
    assert ask(adapter, b"N") == b"NSB01\r"
    assert ask(adapter, b"") == b"\r"


def test_frames_are_sent_and_acknowledged(adapter: SlcanAdapter, controller: Controller) -> None:
    ask(adapter, b"S8\rO")
    assert ask(adapter, b"t1002AABB\rT000001231FF\rr1004\rR000001231") == b"z\rZ\rz\rZ\r"
    assert controller.sent == [
        Frame(0x100, b"\xaa\xbb"),
        Frame(0x123, b"\xff", True),
        Frame(0x100, b"", False, True, 4),
        Frame(0x123, b"", True, True, 1),
    ]
    assert ask(adapter, b"t1002AA") == b"\a"


def test_listening_only_sends_nothing(adapter: SlcanAdapter, controller: Controller) -> None:
    ask(adapter, b"S8")
    assert ask(adapter, b"L") == b"\r"
    assert controller.opened == (1_000_000, True)
    assert ask(adapter, b"t1000") == b"\a"
    assert controller.sent == []


def test_full_queue_is_refused_and_told_once(adapter: SlcanAdapter, controller: Controller) -> None:
    ask(adapter, b"S8\rO")
    controller.room = False
    assert ask(adapter, b"t1000") == b"\a"
    assert ask(adapter, b"F") == b"F02\r"
    assert ask(adapter, b"F") == b"F00\r"
    controller.own_flags = SlcanStatus.BUS_ERROR
    assert ask(adapter, b"F") == b"F80\r"


def test_received_frames_come_only_while_open_and_stamped_on_request(adapter: SlcanAdapter) -> None:
    frame, at = Frame(0x123, b"\x01"), Instant(61_234 * NS_PER_MS)
    assert adapter.hear(frame, at) is None
    ask(adapter, b"Z1\rS8\rO")
    assert adapter.hear(frame, at) == b"t12310104D2\r"
    ask(adapter, b"C\rZ0\rO")
    assert adapter.hear(frame, at) == b"t123101\r"


def test_polling_hands_out_what_was_kept(adapter: SlcanAdapter) -> None:
    ask(adapter, b"X0\rS8\rO")
    for number in range(3):
        assert adapter.hear(Frame(0x100 + number), Instant(0)) is None
    assert ask(adapter, b"P") == b"t1000\r"
    assert ask(adapter, b"A") == b"t1010\rt1020\rA\r"
    assert ask(adapter, b"P") == b"\r"
    for number in range(POLLED_FRAMES_MAX + 1):
        adapter.hear(Frame(number), Instant(0))
    assert ask(adapter, b"F") == b"F01\r"


def test_filter_commands_let_through_what_matches(adapter: SlcanAdapter) -> None:
    # both filters of the dual mode on identifier 0x181, remote bit included
    code = 0x181 << 5
    ask(adapter, b"M%04X%04X\rm000F000F\rS8\rO" % (code, code))
    assert adapter.hear(Frame(0x181), Instant(0)) is not None
    assert adapter.hear(Frame(0x182), Instant(0)) is None
    assert adapter.hear(Frame(0x181, b"", False, True, 1), Instant(0)) is None


@pytest.mark.parametrize("single", [False, True])
def test_acceptance_filter_of_extended_identifiers(single: bool) -> None:
    can_id = 0x12345678
    code = can_id << 3 if single else (can_id >> 13) << 16 | can_id >> 13
    acceptance = AcceptanceFilter(code, 0x0000_0007 if single else 0, single)
    assert acceptance.passes(Frame(can_id, b"", True))
    assert not acceptance.passes(Frame(can_id ^ 1 << 20, b"", True))
    assert acceptance.passes(Frame(can_id ^ 1, b"", True)) is not single, "dual mode sees 16 bits only"
