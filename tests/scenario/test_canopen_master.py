"""python canopen, as it is, as an independent master of the simulated device.

Without a thread: a bus whose ``send`` hands the frame to the device and the answers back to the
network, so that they wait in the master's queue before it looks. One test runs master and device in
real time over python-can's own virtual bus.
"""

import io
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import can
import canopen
import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from servobench.drivers.wire.message import frame_of
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.device.device_options import DeviceIdentity
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import serve
from tests.unit.virtual_bus.device_bench import (
    COUNT,
    DEFAULTS,
    LEVEL,
    NODE,
    NOTE,
    TARGET,
    RecordingApplication,
)

IDENTITY = DeviceIdentity(
    vendor_id=0x80000319, product_code=0xABCDEF01, revision_number=0x10002, serial_number=77
)


def make_device(node_id: int = NODE) -> CanopenDevice:
    return CanopenDevice(node_id, RecordingApplication(), replace(DEFAULTS, identity=IDENTITY))


def data_sheet(device: CanopenDevice) -> io.StringIO:
    text = io.StringIO(export_eds(device.dictionary))
    text.name = "device.eds"
    return text


class Wire(can.BusABC):
    """A bus without delay between one master and one device."""

    def __init__(self, device: CanopenDevice, network: canopen.Network) -> None:
        self.channel_info = "wire"
        self.now = Instant(0)
        self._device = device
        self._network = network
        super().__init__("wire")

    def power_on(self) -> None:
        self._answer(self._device.start(self.now))

    def run_until_ms(self, milliseconds: int) -> None:
        until = Instant(milliseconds * NS_PER_MS)
        while (due := self._device.wake_at) is not None and due <= until:
            self.now = max(self.now, due)
            self._answer(self._device.wake(self.now))
        self.now = until

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        self._answer(self._device.receive(frame_of(msg), self.now))

    def _answer(self, frames: Sequence[Frame]) -> None:
        for frame in frames:
            self._network.notify(frame.can_id, bytearray(frame.data), self.now * 1e-9)


class Master:
    """A canopen network on a wire."""

    def __init__(self, node_id: int = NODE) -> None:
        self.device = make_device(node_id)
        self.network = canopen.Network()
        self.wire = Wire(self.device, self.network)
        self.network.bus = self.wire
        # Half of canopen is untyped.
        self.node: Any = canopen.RemoteNode(NODE, data_sheet(self.device))
        self.network.add_node(self.node)


@pytest.fixture
def master() -> Iterator[Master]:
    made = Master()
    made.wire.power_on()
    yield made
    made.wire.shutdown()


def test_boot_up_and_states(master: Master) -> None:
    node = master.node
    assert node.nmt.state == "PRE-OPERATIONAL"
    for name, state in (
        ("OPERATIONAL", NmtState.OPERATIONAL),
        ("STOPPED", NmtState.STOPPED),
        ("PRE-OPERATIONAL", NmtState.PRE_OPERATIONAL),
    ):
        node.nmt.state = name
        assert master.device.state is state


def test_heartbeat_tells_the_state(master: Master) -> None:
    node = master.node
    node.sdo[0x1017].raw = 10
    master.network.nmt.state = "OPERATIONAL"
    node.nmt._state = 0
    master.wire.run_until_ms(15)
    assert node.nmt.state == "OPERATIONAL"


def test_expedited_and_segmented(master: Master) -> None:
    sdo = master.node.sdo
    sdo[TARGET].raw = -123
    assert sdo[TARGET].raw == -123
    assert sdo[0x1008].raw == "simulated device"
    text = bytes(range(256)) * 3
    sdo[NOTE].raw = text
    assert sdo[NOTE].raw == text


@pytest.mark.parametrize("length", [1, 7, 889, 890, 5000])
def test_block_both_ways(master: Master, length: int) -> None:
    content = bytes(number * 7 & 0xFF for number in range(length))
    with master.node.sdo[NOTE].open("wb", size=length, block_transfer=True) as stream:
        stream.write(content)
    assert master.device.dictionary.variable(NOTE).value == content
    with master.node.sdo[NOTE].open("rb", block_transfer=True) as stream:
        assert stream.read() == content


def test_abort_codes_arrive(master: Master) -> None:
    for index, subindex, data, code in (
        (TARGET, 0, b"\xe9\x03", 0x06090031),
        (0x1000, 0, bytes(4), 0x06010002),
        (0x5555, 0, b"\x00", 0x06020000),
        (0x1018, 7, b"\x00", 0x06090011),
        (LEVEL, 0, bytes(3), 0x06070013),
    ):
        with pytest.raises(canopen.SdoAbortedError) as aborted:
            master.node.sdo.download(index, subindex, data)
        assert aborted.value.code == code


def test_reads_the_pdo_configuration_and_gets_tpdos_by_sync(master: Master) -> None:
    node = master.node
    node.tpdo.read()
    node.rpdo.read()
    assert [variable.index for variable in node.tpdo[1].map] == [COUNT, LEVEL]
    node.nmt.state = "OPERATIONAL"
    node.rpdo[1][TARGET].raw = 55
    node.rpdo[1][LEVEL].raw = -9
    node.rpdo[1].transmit()
    master.network.sync.transmit()
    assert node.tpdo[1][LEVEL].raw == -9
    assert node.sdo[TARGET].raw == 55


def test_remaps_over_sdo(master: Master) -> None:
    node = master.node
    node.tpdo.read()
    pdo = node.tpdo[2]
    pdo.clear()
    pdo.add_variable(TARGET)
    pdo.add_variable(0x1013)
    pdo.cob_id, pdo.trans_type, pdo.enabled = 0x3A0, 2, True
    pdo.save()
    node.nmt.state = "OPERATIONAL"
    master.wire.run_until_ms(3)
    master.device.dictionary.variable(TARGET).value = -7
    master.network.sync.transmit()
    assert not pdo.is_received
    master.network.sync.transmit()
    assert (pdo[TARGET].raw, pdo[0x1013].raw) == (-7, 3000)


def test_emergencies_arrive(master: Master) -> None:
    master.device.raise_error(0x2310, ErrorRegister.CURRENT, b"abcde")
    master.wire.run_until_ms(1)
    assert [(error.code, error.register, error.data) for error in master.node.emcy.active] == [
        (0x2310, 0x03, b"abcde")
    ]
    master.device.clear_error(0x2310)
    master.wire.run_until_ms(2)
    assert master.node.emcy.active == []


def test_lost_master_is_noticed(master: Master) -> None:
    master.node.sdo[0x1016][1].raw = 127 << 16 | 100
    master.network.send_message(0x77F, b"\x05")
    master.wire.run_until_ms(200)
    assert [error.code for error in master.node.emcy.active] == [0x8130]


def test_lss_master_finds_and_configures_a_device_without_node_id(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("canopen.lss.time", SimpleNamespace(sleep=lambda _seconds: None))
    master = Master(node_id=255)
    lss: Any = master.network.lss
    lss.RESPONSE_TIMEOUT = 0.001
    master.wire.power_on()
    identity = [IDENTITY.vendor_id, IDENTITY.product_code, IDENTITY.revision_number, IDENTITY.serial_number]
    assert lss.fast_scan() == (True, identity)
    lss.configure_node_id(NODE)
    lss.store_configuration()
    lss.send_switch_state_global(lss.WAITING_STATE)
    assert master.node.nmt.state == "PRE-OPERATIONAL"
    assert master.node.sdo[0x1018][4].raw == 77
    assert lss.fast_scan() == (False, None)
    assert lss.send_switch_state_selective(*identity)
    assert lss.inquire_node_id() == NODE
    assert lss.inquire_lss_address(0x5D) == 77
    master.wire.shutdown()


def test_in_real_time_with_the_masters_own_thread() -> None:
    device, stop = make_device(), threading.Event()
    bus = can.Bus(interface="virtual", channel="canopen-master")
    network = canopen.Network()
    network.connect(interface="virtual", channel="canopen-master")
    node = canopen.RemoteNode(NODE, data_sheet(device))
    network.add_node(node)
    booted = threading.Event()
    node.nmt.add_heartbeat_callback(lambda state: booted.set() if state == 0 else None)
    served = threading.Thread(target=serve, args=([device], bus, MonotonicClock(), stop.is_set))
    served.start()
    try:
        # canopen's own wait_for_bootup misses a boot-up that came before it began to wait
        assert booted.wait(10)
        node.sdo.RESPONSE_TIMEOUT = 10.0
        node.sdo[NOTE].raw = bytes(100)
        assert node.sdo[NOTE].raw == bytes(100)
        node.sdo[0x1017].raw = 20
        assert node.nmt.wait_for_heartbeat(10) == "PRE-OPERATIONAL"
    finally:
        stop.set()
        served.join(10)
        network.disconnect()
        bus.shutdown()
    assert not served.is_alive()
