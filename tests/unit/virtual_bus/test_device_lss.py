"""LSS slave (CiA 305)."""

import pytest

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.device.device_options import DeviceIdentity, DeviceOptions
from servobench.virtual_bus.device.parameter_storage import MemoryStore, ParameterStore
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import Timeline
from tests.unit.virtual_bus.device_bench import RecordingApplication

IDENTITY = DeviceIdentity(vendor_id=0x319, product_code=0x1001, revision_number=2, serial_number=77)
NOW = Instant(0)


def device(node_id: int = 255, store: ParameterStore | None = None) -> CanopenDevice:
    made = CanopenDevice(node_id, RecordingApplication(), DeviceOptions(IDENTITY, heartbeat_ms=10), store)
    made.start(NOW)
    return made


def ask(made: CanopenDevice, command: int, *data: int) -> list[bytes]:
    frames = made.receive(Frame(0x7E5, bytes([command, *data]).ljust(8, b"\x00")), NOW)
    assert all(frame.can_id in (0x7E4, 0x700 + made.node_id) for frame in frames)
    return [frame.data for frame in frames]


def long(made: CanopenDevice, command: int, number: int) -> list[bytes]:
    return ask(made, command, *number.to_bytes(4, "little"))


def test_device_without_node_id_is_silent() -> None:
    made = device()
    assert made.state is NmtState.INITIALISING
    assert made.wake_at is None
    for frame in (Frame(0, b"\x01\x00"), Frame(0x6FF, b"\x40\x00\x10" + bytes(5)), Frame(0x80)):
        assert made.receive(frame, NOW) == ()
    assert made.receive(Frame(0x7FF, remote=True), NOW) == ()
    assert made.state is NmtState.INITIALISING


def test_node_id_takes_effect_on_the_way_back_to_waiting() -> None:
    made = device()
    assert ask(made, 0x04, 1) == []
    assert ask(made, 0x5E)[0][:2] == b"\x5e\xff"
    assert ask(made, 0x11, 9)[0][:2] == b"\x11\x00"
    assert ask(made, 0x04, 0) == [b"\x00"]
    assert (made.node_id, made.state) == (9, NmtState.PRE_OPERATIONAL)
    assert made.receive(Frame(0x609, b"\x40\x00\x10" + bytes(5)), NOW)[0].can_id == 0x589


def test_configured_device_takes_it_at_the_reset_of_the_communication() -> None:
    made = device(5)
    ask(made, 0x04, 1)
    ask(made, 0x11, 9)
    ask(made, 0x04, 0)
    assert made.node_id == 5
    assert made.receive(Frame(0, b"\x82\x05"), NOW) == [Frame(0x709, b"\x00")]
    assert made.receive(Frame(0x605, b"\x40\x00\x10" + bytes(5)), NOW) == ()


def test_node_id_can_be_taken_away() -> None:
    made = device(5)
    ask(made, 0x04, 1)
    ask(made, 0x11, 255)
    ask(made, 0x04, 0)
    assert made.receive(Frame(0, b"\x82\x05"), NOW) == ()
    assert (made.state, made.wake_at) == (NmtState.INITIALISING, None)
    assert ask(made, 0x4C)[0][0] == 0x50


@pytest.mark.parametrize("node_id", [0, 128, 254])
def test_node_id_out_of_range(node_id: int) -> None:
    made = device()
    ask(made, 0x04, 1)
    assert ask(made, 0x11, node_id)[0][:2] == b"\x11\x01"


@pytest.mark.parametrize(
    ("selector", "index", "error"), [(0, 0, 0), (0, 8, 0), (0, 5, 1), (0, 9, 1), (1, 0, 1)]
)
def test_bit_timing_table(selector: int, index: int, error: int) -> None:
    made = device()
    ask(made, 0x04, 1)
    assert ask(made, 0x13, selector, index)[0][:2] == bytes([0x13, error])


@pytest.mark.parametrize("command", [0x11, 0x13, 0x17, 0x5A, 0x5B, 0x5C, 0x5D, 0x5E])
def test_configuration_services_need_the_configuration_state(command: int) -> None:
    assert ask(device(), command, 1) == []


def test_stored_node_id_outlives_a_power_cycle() -> None:
    store = MemoryStore()
    made = device(255, store)
    ask(made, 0x04, 1)
    ask(made, 0x11, 33)
    assert ask(made, 0x17)[0][:2] == b"\x17\x00"
    again = device(255, store)
    assert (again.node_id, again.state) == (33, NmtState.PRE_OPERATIONAL)


def test_node_id_that_was_not_stored_does_not_outlive_it() -> None:
    made = device()
    ask(made, 0x04, 1)
    ask(made, 0x11, 33)
    made.start(NOW)
    assert made.node_id == 255
    assert ask(made, 0x5E) == []


def test_selective_switch_needs_the_whole_identity_in_order() -> None:
    parts = (IDENTITY.vendor_id, IDENTITY.product_code, IDENTITY.revision_number, IDENTITY.serial_number)
    made = device(5)
    for wrong in range(4):
        answers = [long(made, 0x40 + part, number + (part == wrong)) for part, number in enumerate(parts)]
        assert answers == [[], [], [], []]
    assert long(made, 0x43, parts[3]) == []
    assert [long(made, 0x40 + part, number) for part, number in enumerate(parts)][3][0][0] == 0x44
    assert [ask(made, 0x5A + part)[0][1:5] for part in range(4)] == [
        number.to_bytes(4, "little") for number in parts
    ]


@pytest.mark.parametrize(
    ("low", "high", "found"), [(77, 77, True), (0, 100, True), (78, 100, False), (0, 76, False)]
)
def test_identify_by_a_range_of_serial_numbers(low: int, high: int, found: bool) -> None:
    made = device(5)
    numbers = (IDENTITY.vendor_id, IDENTITY.product_code, 0, 10, low, high)
    answers = [long(made, 0x46 + step, number) for step, number in enumerate(numbers)]
    assert answers[:5] == [[]] * 5
    assert bool(answers[5]) is found


def test_identify_unconfigured() -> None:
    assert ask(device(), 0x4C)[0][0] == 0x50
    assert ask(device(5), 0x4C) == []


def test_configured_device_takes_no_part_in_a_fast_scan() -> None:
    assert ask(device(5), 0x51, 0, 0, 0, 0, 0x80, 0, 0) == []


class FullStore(MemoryStore):
    """Memory that takes nothing."""

    def save(self, parameters: dict[tuple[int, int], bytes]) -> None:
        raise OSError(28, f"no space left for {len(parameters)} parameters")


def test_failing_memory_is_told() -> None:
    made = device(255, FullStore())
    ask(made, 0x04, 1)
    assert ask(made, 0x17)[0][:2] == b"\x17\x02"


def test_malformed_requests_are_ignored() -> None:
    made = device()
    assert made.receive(Frame(0x7E5, b"\x4c"), NOW) == ()
    assert ask(made, 0x04, 2) == []
    assert ask(made, 0x99) == []
    ask(made, 0x04, 1)
    assert long(made, 0x40, IDENTITY.vendor_id) == []


def test_fast_scan_beyond_its_ranges_is_ignored() -> None:
    made = device()
    assert ask(made, 0x51, 0, 0, 0, 0, 0x80, 0, 0)[0][0] == 0x4F
    for bit, part, following in ((32, 0, 0), (31, 4, 0), (31, 0, 4), (31, 1, 1)):
        assert ask(made, 0x51, 0, 0, 0, 0, bit, part, following) == []
    assert ask(made, 0x51, 0, 0, 0, 0x80, 31, 0, 0) == []
    assert ask(made, 0x51, 0, 0, 0, 0, 31, 0, 0)[0][0] == 0x4F


def test_bit_rate_is_changed_after_the_switch_delay_and_followed_by_silence() -> None:
    made = device(5)
    rates: list[int] = []
    made.follow_bit_rate(rates.append)
    ask(made, 0x15, 20)
    ask(made, 0x04, 1)
    ask(made, 0x15, 20)
    assert made.wake(Instant(25 * NS_PER_MS)) != (), "not configured, so nothing was activated"
    assert ask(made, 0x13, 0, 2)[0][:2] == b"\x13\x00"
    start = 30 * NS_PER_MS
    made.receive(Frame(0x7E5, b"\x15\x14" + bytes(6)), Instant(start))
    seen = {}
    for milliseconds in range(31, 91):
        seen[milliseconds] = (
            [frame.can_id for frame in made.wake(Instant(milliseconds * NS_PER_MS))],
            [*rates],
        )
    assert next(ms for ms, (_, found) in seen.items() if found == [500_000]) == 50
    beats = [ms for ms, (frames, _) in seen.items() if frames == [0x705]]
    assert [ms for ms in beats if 50 <= ms < 70] == []
    assert [ms for ms in beats if ms < 50]
    assert all(len(frames) <= 1 for frames, _ in seen.values()), "what was held back is not sent later"
    assert [ms for ms in beats if ms >= 70]


def test_without_a_switch_delay_the_bit_rate_is_changed_at_once() -> None:
    made = device(5)
    rates: list[int] = []
    made.follow_bit_rate(rates.append)
    ask(made, 0x04, 1)
    ask(made, 0x13, 0, 4)
    assert rates == []
    ask(made, 0x15, 0, 0)
    assert rates == [125_000]


def test_stored_bit_rate_is_that_of_the_next_power_on() -> None:
    store = MemoryStore()
    made = device(5, store)
    ask(made, 0x04, 1)
    ask(made, 0x17)
    ask(made, 0x13, 0, 3)
    rates: list[int] = []
    made.follow_bit_rate(rates.append)
    made.start(NOW)
    assert rates == [], "it was not stored"
    ask(made, 0x04, 1)
    ask(made, 0x13, 0, 3)
    ask(made, 0x17)
    made.start(NOW)
    assert rates == [250_000]


def test_activated_bit_rate_is_that_of_its_controller_on_a_segment() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    made = CanopenDevice(5, RecordingApplication(), DeviceOptions(IDENTITY))
    attached = AttachedDevice(made, segment)
    master = segment.attach("master", Listener())
    for request in (b"\x04\x01", b"\x13\x00\x02", b"\x15\x05"):
        master.send(Frame(0x7E5, request.ljust(8, b"\x00")))
    timeline.run_until(Instant(4 * NS_PER_MS))
    assert attached.port.controller.bitrate_bit_s == 1_000_000
    timeline.run_until(Instant(7 * NS_PER_MS))
    assert attached.port.controller.bitrate_bit_s == 500_000
    master.send(Frame(0x123))
    timeline.run_until(Instant(8 * NS_PER_MS))
    assert segment.errors > 0, "at half the rate it destroys the frames of the others"
