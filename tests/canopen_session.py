"""A session of python canopen with the simulated device: a log of every frame, and the values that it has.

So a log has all that CANopen has to say, and a second decoder's word for each value.
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import can
import canopen
import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Instant
from servobench.drivers.wire.message import frame_of
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.frame import Frame
from tests.scenario.test_canopen_master import IDENTITY, Wire, data_sheet, make_device
from tests.unit.virtual_bus.device_bench import LEVEL, NODE, NOTE, RATIO, TARGET, TRIPLE

TEXT = bytes(number * 7 & 0xFF for number in range(2000))
LINE_US = 150


class Witnessed(NamedTuple):
    """The session."""

    lines: list[str]
    """candump -L."""
    sheet: str
    """The device's EDS."""
    values: dict[tuple[int, int], Any]
    """By canopen: the last value of each object that was read or written by SDO."""
    pdo: tuple[int, int]
    """By canopen: TARGET and 1013h out of the last TPDO2."""


class LoggingWire(Wire):
    """Writes down what passes, each frame 150 us after the one before."""

    def __init__(self, device: Any, network: canopen.Network) -> None:
        super().__init__(device, network)
        self.lines: list[str] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._log(frame_of(msg).can_id, bytes(msg.data), remote=msg.is_remote_frame)
        super().send(msg, timeout)

    def raw(self, line: str) -> None:
        """A frame that nobody sends through canopen."""
        self._lines_at(line)

    def _answer(self, frames: Sequence[Frame]) -> None:
        for frame in frames:
            self._log(frame.can_id, bytes(frame.data))
        super()._answer(frames)

    def _log(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
        self._lines_at(f"{can_id:03X}#{'R' if remote else data.hex().upper()}")

    def _lines_at(self, text: str) -> None:
        at_us = self.now // NS_PER_US + LINE_US * len(self.lines)
        self.lines.append(f"({1_700_000_000 + at_us // 1_000_000:010d}.{at_us % 1_000_000:06d}) can0 {text}")


def session(monkeypatch: pytest.MonkeyPatch) -> Witnessed:
    """NMT, guarding, LSS, SDO of each kind with aborts, a PDO mapped anew, SYNC, TIME, EMCY, error frames."""
    monkeypatch.setattr("canopen.lss.time", SimpleNamespace(sleep=lambda _seconds: None))
    network = canopen.Network()
    device = make_device(255)
    wire = network.bus = LoggingWire(device, network)
    node: Any = canopen.RemoteNode(NODE, data_sheet(make_device()))
    network.add_node(node)
    lss: Any = network.lss
    lss.RESPONSE_TIMEOUT = 0.001
    wire.power_on()
    assert lss.fast_scan()[0]
    lss.configure_node_id(NODE)
    lss.send_switch_state_global(lss.WAITING_STATE)
    identity = (IDENTITY.vendor_id, IDENTITY.product_code, IDENTITY.revision_number, IDENTITY.serial_number)
    assert lss.send_switch_state_selective(*identity)
    assert lss.inquire_node_id() == NODE
    lss.send_switch_state_global(lss.WAITING_STATE)
    values = _sdo(node)
    pdo = _pdo(node, device, wire, network)
    network.time.transmit(1_700_000_000.25)
    wire.raw("20000088#0000040800000C22")
    network.send_message(0x700 + NODE, b"", True)
    device.raise_error(0x2310, ErrorRegister.CURRENT, b"abcde")
    wire.run_until_ms(10)
    node.nmt.state = "STOPPED"
    wire.shutdown()
    return Witnessed(wire.lines, export_eds(make_device().dictionary), values, pdo)


def _sdo(node: Any) -> dict[tuple[int, int], Any]:
    sdo = node.sdo
    sdo[TARGET].raw = -123
    sdo[LEVEL].raw = -70_000
    sdo[TRIPLE].raw = -300_000
    sdo[RATIO].raw = 0.5
    sdo[NOTE].raw = TEXT[:300]
    with sdo[NOTE].open("wb", size=len(TEXT), block_transfer=True) as stream:
        stream.write(TEXT)
    with sdo[NOTE].open("rb", block_transfer=True) as stream:
        assert stream.read() == TEXT
    for index, sub, data in ((TARGET, 0, b"\xe9\x03"), (0x5555, 0, b"\0"), (0x1018, 7, b"\0")):
        with pytest.raises(canopen.SdoAbortedError):
            sdo.download(index, sub, data)
    found: dict[tuple[int, int], Any] = {
        (index, 0): sdo[index].raw for index in (TARGET, LEVEL, TRIPLE, RATIO, NOTE, 0x1000, 0x1008, 0x1001)
    }
    return found | {(0x1018, sub): sdo[0x1018][sub].raw for sub in (1, 2, 3, 4)}


def _pdo(node: Any, device: Any, wire: LoggingWire, network: canopen.Network) -> tuple[int, int]:
    node.tpdo.read()
    pdo = node.tpdo[2]
    pdo.clear()
    pdo.add_variable(TARGET)
    pdo.add_variable(0x1013)
    pdo.cob_id, pdo.trans_type, pdo.enabled = 0x3A0, 1, True
    pdo.save()
    node.nmt.state = "OPERATIONAL"
    wire.run_until_ms(3)
    device.dictionary.variable(TARGET).value = -7
    wire.now = Instant(5 * NS_PER_MS)
    network.sync.transmit(3)
    return pdo[TARGET].raw, pdo[0x1013].raw
