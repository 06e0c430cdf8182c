"""python canopen's own CiA 402 client, with its Notifier thread, moves the simulated drive: SDO, and PDO."""

import io
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import can
import canopen
import pytest
from canopen.profiles.p402 import OperationMode

from servobench.drivers.cia402.objects402 import Object
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.contract.conformance.live_device import live_servo

NODE = 1
PATIENCE_S = 20.0
COUNTS = 65_536
NEW_SET_POINT = 0x3F
ENABLED = 0x0F
BY_BITS = ("VELOCITY", "INTERPOLATED POSITION")
"""Modes that follow only with bits of the controlword, which this client leaves to whoever uses it."""
MODES = (
    "PROFILED POSITION",
    "PROFILED VELOCITY",
    "PROFILED TORQUE",
    "HOMING",
    "CYCLIC SYNCHRONOUS POSITION",
    "CYCLIC SYNCHRONOUS VELOCITY",
    "CYCLIC SYNCHRONOUS TORQUE",
)


def eventually(condition: Callable[[], bool]) -> bool:
    """Whether ``condition`` comes true while the Notifier works."""
    waiting = threading.Event()
    return any(condition() or waiting.wait(0.02) for _ in range(round(PATIENCE_S / 0.02)))


def data_sheet(device: SimulatedServo) -> io.StringIO:
    text = io.StringIO(export_eds(device.dictionary))
    text.name = "servo.eds"
    return text


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A directory for the hub, known to whoever joins it."""
    folder = tmp_path_factory.mktemp("hub")
    folder.chmod(0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        yield folder


@contextmanager
def client(channel: str) -> Iterator[Any]:
    """A BaseNode402 of a drive on a hub of its own, PRE-OPERATIONAL and not set up yet."""
    options: dict[str, Any] = {"interface": "hub", "channel": channel, "bitrate": 1_000_000}
    with live_servo(lambda: can.Bus(**options, ignore_config=True), NODE) as device:
        network: Any = canopen.Network()
        network.connect(**options)
        try:
            make: Any = canopen.BaseNode402
            node = make(NODE, data_sheet(device))
            network.add_node(node)
            node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
            for limit in ("STATE_FINAL", "STATE_SINGLE", "OP_MODE"):
                setattr(node, f"TIMEOUT_SWITCH_{limit}", PATIENCE_S)
            yield node
        finally:
            network.disconnect()


@pytest.fixture(scope="module")
def node(runtime: Path) -> Iterator[Any]:  # noqa: ARG001
    with client("by-SDO") as node:
        node.nmt.state = "OPERATIONAL"
        # Its states come from SDO: it looks for 6041h in TPDOs that are sent without a SYNC.
        node.setup_402_state_machine(False)
        yield node


def position(node: Any) -> int:
    return int(node.sdo[Object.POSITION_ACTUAL_VALUE].raw)


def status(node: Any) -> int:
    return int(node.sdo[Object.STATUSWORD].raw)


def test_states_modes_moves_and_homing(node: Any) -> None:
    node.op_mode = "PROFILED POSITION"
    assert node.op_mode == "PROFILED POSITION"
    node.state = "OPERATION ENABLED"
    assert node.state == "OPERATION ENABLED"

    node.sdo[Object.TARGET_POSITION].raw = 2 * COUNTS
    node.controlword = NEW_SET_POINT
    assert eventually(lambda: bool(status(node) & 0x1000))
    node.controlword = ENABLED
    assert eventually(lambda: status(node) & 0x1400 == 0x400)
    assert position(node) == pytest.approx(2 * COUNTS, abs=200)

    node.op_mode = "PROFILED VELOCITY"
    node.sdo[Object.TARGET_VELOCITY].raw = 60_000
    assert eventually(lambda: abs(int(node.sdo[Object.VELOCITY_ACTUAL_VALUE].raw) - 60_000) < 3000)
    node.sdo[Object.TARGET_VELOCITY].raw = 0
    assert eventually(lambda: bool(status(node) & 0x1000)), "standstill"

    node.op_mode = "HOMING"
    node.sdo[Object.HOMING_METHOD].raw = 34
    node.controlword = ENABLED
    node.controlword = 0x1F
    assert eventually(lambda: node.is_homed())
    assert abs(position(node)) < COUNTS // 4

    node.state = "SWITCH ON DISABLED"
    assert node.state == "SWITCH ON DISABLED"


def test_every_mode_that_it_knows_and_6502h_offers_is_taken(node: Any) -> None:
    taken = []
    for name in (*MODES, *BY_BITS):
        assert node.is_op_mode_supported(name)
        node.op_mode = name
        taken.append(node.op_mode == name)
    assert all(taken)


def test_velocity_and_interpolated_position(node: Any) -> None:
    node.op_mode = "VELOCITY"
    node.state = "OPERATION ENABLED"
    node.sdo[Object.VL_VELOCITY_ACCELERATION][1].raw = 20_000
    node.sdo[Object.VL_TARGET_VELOCITY].raw = -60
    node.controlword = 0x7F
    assert eventually(lambda: abs(int(node.sdo[Object.VL_VELOCITY_ACTUAL_VALUE].raw) + 60) <= 3)
    node.controlword = 0x3F  # without reference ramp
    assert eventually(lambda: abs(int(node.sdo[Object.VL_VELOCITY_ACTUAL_VALUE].raw)) <= 3)
    node.controlword = ENABLED

    node.op_mode = "INTERPOLATED POSITION"
    target = position(node) + COUNTS // 64
    node.sdo[Object.INTERPOLATION_DATA_RECORD][1].raw = target
    assert not status(node) & 0x1000
    node.controlword = 0x1F
    assert eventually(lambda: status(node) & 0x1400 == 0x1400)
    assert position(node) == pytest.approx(target, abs=200)
    node.state = "SWITCH ON DISABLED"


class ByPdo:
    """The client with everything in PDOs on change, the defaults of CiA 402-2 for statusword and mode."""

    def __init__(self, node: Any, event_timer_ms: int) -> None:
        self.node = node
        node.pdo.read()
        for number, objects in enumerate(
            (
                (Object.CONTROLWORD, Object.MODES_OF_OPERATION),
                (Object.TARGET_POSITION, Object.TARGET_VELOCITY),
                (Object.TARGET_TORQUE,),
            ),
            1,
        ):
            self._map(node.rpdo[number], objects)
        for number, objects in enumerate(
            (
                (Object.STATUSWORD, Object.MODES_OF_OPERATION_DISPLAY),
                (Object.POSITION_ACTUAL_VALUE, Object.VELOCITY_ACTUAL_VALUE),
                (Object.TORQUE_ACTUAL_VALUE, Object.ERROR_CODE),
            ),
            1,
        ):
            node.tpdo[number].inhibit_time = 0 if number == 1 else 100
            node.tpdo[number].event_timer = event_timer_ms if number == 1 else 0
            self._map(node.tpdo[number], objects)
        if event_timer_ms:
            node.tpdo[1].period = event_timer_ms / 1000  # then it waits for the TPDO, and asks no SDO
        node.setup_402_state_machine(False)
        assert node.is_op_mode_supported("HOMING")  # reads 6502h once
        node.nmt.state = "OPERATIONAL"
        self.asked: list[bytes] = []
        send = node.network.send_message

        def noted(can_id: int, data: bytes, remote: bool = False) -> None:
            if can_id == 0x600 + NODE:
                self.asked.append(bytes(data))
            send(can_id, data, remote)

        node.network.send_message = noted

    @staticmethod
    def _map(pdo: Any, objects: tuple[Object, ...]) -> None:
        pdo.clear()
        for index in objects:
            pdo.add_variable(index)
        pdo.trans_type, pdo.enabled = 255, True
        pdo.save()

    def told(self, index: int) -> int:
        """The last value in a TPDO."""
        return int(self.node.tpdo_values[index])

    def set(self, number: int, **values: int) -> None:
        """RPDO ``number``, at once."""
        pdo = self.node.rpdo[number]
        for title, value in values.items():
            pdo[Object[title]].raw = value
        pdo.transmit()

    def enter(self, state: str) -> None:
        """It waits for one more TPDO even where the one it needs has come; then it is asked again."""

        def reached() -> bool:
            with suppress(RuntimeError):
                self.node.state = state
            return bool(self.node.state == state)

        assert eventually(reached)

    def change(self, mode: str) -> None:
        """A mode by RPDO1, confirmed in TPDO1; beside that as :meth:`enter`."""
        self.node.op_mode = mode
        code = OperationMode.NAME2CODE[mode]
        assert eventually(lambda: self.told(Object.MODES_OF_OPERATION_DISPLAY) == code)

    def comes_within(self, index: int, value: int, width: int) -> bool:
        return eventually(lambda: abs(self.told(index) - value) < width)

    def move(self, mode: str) -> None:
        """Motion by the set-point of ``mode``, as TPDOs tell it."""
        if mode == "HOMING":
            self.node.controlword = 0x1F
            assert eventually(lambda: self.told(Object.STATUSWORD) & 0x3400 == 0x1400)
        elif mode == "PROFILED POSITION":
            self.set(2, TARGET_POSITION=COUNTS)
            self.node.controlword = NEW_SET_POINT
            assert eventually(lambda: bool(self.told(Object.STATUSWORD) & 0x1000))
            self.node.controlword = ENABLED
            assert self.comes_within(Object.POSITION_ACTUAL_VALUE, COUNTS, 200)
        elif "POSITION" in mode:
            self.set(2, TARGET_POSITION=self.told(Object.POSITION_ACTUAL_VALUE) + 5000)
            target = self.node.rpdo[2][Object.TARGET_POSITION].raw
            assert self.comes_within(Object.POSITION_ACTUAL_VALUE, target, 200)
        elif "VELOCITY" in mode:
            self.set(2, TARGET_VELOCITY=60_000)
            assert self.comes_within(Object.VELOCITY_ACTUAL_VALUE, 60_000, 3000)
            self.set(2, TARGET_VELOCITY=0)
        else:
            self.set(3, TARGET_TORQUE=150)
            assert self.comes_within(Object.TORQUE_ACTUAL_VALUE, 150, 30)
            self.set(3, TARGET_TORQUE=0)


@pytest.mark.parametrize("event_timer_ms", [0, 20])
def test_all_modes_by_pdo_alone(runtime: Path, event_timer_ms: int) -> None:  # noqa: ARG001
    """CiA 402-2: 6040h + 6060h in one RPDO on change, 6041h + 6061h in one TPDO on change."""
    with client(f"by-PDO-{event_timer_ms}") as node:
        drive = ByPdo(node, event_timer_ms)
        for mode in MODES:
            drive.change(mode)
            if "POSITION" in mode:
                drive.set(2, TARGET_POSITION=drive.told(Object.POSITION_ACTUAL_VALUE))
            drive.enter("OPERATION ENABLED")
            drive.move(mode)
            drive.enter("SWITCHED ON")

        drive.change("CYCLIC SYNCHRONOUS POSITION")
        drive.enter("OPERATION ENABLED")
        drive.set(2, TARGET_POSITION=drive.told(Object.POSITION_ACTUAL_VALUE) + 50 * COUNTS)
        assert eventually(lambda: node.state == "FAULT")
        assert eventually(lambda: drive.told(Object.ERROR_CODE) == 0x8611)
        # Where it knows no period, canopen paces its waiting by reading 6041h.
        assert {request[:4] for request in drive.asked} <= (
            {b"\x40\x41\x60\x00"} if not event_timer_ms else set()
        )


@pytest.mark.parametrize("reset", ["RESET", "RESET COMMUNICATION"])
def test_a_reset_drive_is_driven_on_from_its_boot_up(runtime: Path, reset: str) -> None:  # noqa: ARG001
    with client(reset.replace(" ", "-")) as node:
        heard: list[bytes] = []
        node.network.subscribe(0x700 + NODE, lambda _id, data, _at: heard.append(bytes(data)))
        node.nmt.state = "OPERATIONAL"
        node.setup_402_state_machine(False)
        node.state = "OPERATION ENABLED"
        node.nmt.state = reset
        assert eventually(lambda: heard[-1:] == [b"\0"])
        assert node.nmt.state == "PRE-OPERATIONAL"
        node.nmt.state = "OPERATIONAL"
        node.state = "SWITCH ON DISABLED"
        node.state = "OPERATION ENABLED"
        assert node.state == "OPERATION ENABLED"
