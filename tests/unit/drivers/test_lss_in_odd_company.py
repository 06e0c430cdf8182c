"""LSS against slaves as they are: those that answer where CiA 305 has them silent, and those that mislead."""

from collections.abc import Callable

import pytest

from servobench.drivers.canopen.lss import LssAddress, LssMaster
from servobench.drivers.errors import NoAnswer, PeerFault
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.virtual_bus.frame import Frame
from tests.hearing import Hearing
from tests.unit.drivers.test_bus_scan import UNCONFIGURED, Bench

Answerer = Callable[[bytes], bytes | None]


def yes_sayers(*serials: int) -> Bench:
    """Devices that answer each frame of a fast scan in the configuration state, as CANopenNode's do."""
    bench = Bench()
    for serial in serials:
        bench.add(UNCONFIGURED, serial).answer_scan_in_configuration()
    return bench


def with_slave(answer: Answerer) -> Bench:
    bench = Bench()

    def on_frame(frame: Frame, _at: Instant) -> None:
        told = answer(frame.data) if frame.can_id == 0x7E5 else None
        if told is not None:
            port.send(Frame(0x7E4, told.ljust(8, b"\0")))

    port = bench.segment.attach("odd slave", Hearing(on_frame))
    return bench


def test_one_device_that_answers_fast_scan_in_configuration_is_found_once() -> None:
    """CiA 305, fastscan: a service of the LSS state waiting; CANopenNode answers it in the other one, too."""
    bench = yes_sayers(77)
    began = bench.timeline.now
    found = list(LssMaster(bench.network).search())
    assert [address.serial_number for address in found] == [77]
    assert bench.timeline.now - began < 15 * NS_PER_S


def test_a_device_that_was_left_in_configuration_is_called_back_first() -> None:
    bench = yes_sayers(77)
    bench.network.link.send(0x7E5, b"\x04\x01".ljust(8, b"\0"))
    (address,) = LssMaster(bench.network).search()
    assert address.serial_number == 77


def test_a_slave_that_says_yes_to_whatever_it_is_asked_is_no_device_of_identity_zero() -> None:
    answers = {0x5A: 0x319, 0x5B: 2, 0x5C: 3, 0x5D: 4}

    def answer(request: bytes) -> bytes | None:
        if request[0] == 0x51:
            return b"\x4f"
        return (
            bytes([request[0]]) + answers[request[0]].to_bytes(4, "little") if request[0] in answers else None
        )

    bench = with_slave(answer)
    found: list[LssAddress] = []
    with pytest.raises(PeerFault, match=r"vendor 00000000h.*vendor 00000319h"):
        found.extend(LssMaster(bench.network).search())
    assert found == []


def test_a_slave_that_only_says_yes_is_none_at_all() -> None:
    bench = with_slave(lambda request: b"\x4f" if request[0] == 0x51 else None)
    with pytest.raises(NoAnswer, match="does not answer to its LSS address"):
        list(LssMaster(bench.network).search())


class Unasked:
    """A slave that takes part in fast scans and is selected by its address, but answers no inquiry."""

    def __init__(self, address: LssAddress) -> None:
        self._address = address
        self._part = 0
        self._selected: list[int] = []

    def __call__(self, request: bytes) -> bytes | None:
        command, number = request[0], int.from_bytes(request[1:5], "little")
        if command == 0x51:
            return b"\x4f" if self._is_meant(number, *request[5:8]) else None
        if command == 0x40:
            self._selected.clear()
        if 0x40 <= command <= 0x43:
            self._selected.append(number)
            return b"\x44" if tuple(self._selected) == self._address else None
        return None

    def _is_meant(self, number: int, bit: int, part: int, following: int) -> bool:
        if bit == 0x80:
            self._part = 0
            return True
        if part != self._part or (self._address[part] ^ number) >> bit:
            return False
        if not bit:
            self._part = following
        return True


def test_a_device_that_answers_no_inquiry_is_found_if_it_answers_to_its_address() -> None:
    address = LssAddress(0x319, 2, 3, 0x80000001)
    assert list(LssMaster(with_slave(Unasked(address)).network).search(limit=1)) == [address]


def test_two_devices_of_one_identity_are_told() -> None:
    bench = Bench()
    for _ in range(2):
        bench.add(UNCONFIGURED, 77)
    with pytest.raises(PeerFault, match=r"2 devices .* serial 0000004Dh"):
        list(LssMaster(bench.network).search())
