"""python canopen's own CiA 402 client, with its Notifier thread, moves the simulated drive on a hub."""

import io
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import canopen
import pytest

from drivers.cia402.objects402 import Object
from tests.contract.conformance.live_device import live_servo
from tests.eds_export import export_eds
from virtual_bus.device.device_options import DeviceIdentity
from virtual_bus.drive.servo import SimulatedServo

NODE = 1
PATIENCE_S = 20.0
COUNTS = 65_536
NEW_SET_POINT = 0x3F
ENABLED = 0x0F


def eventually(condition: Callable[[], bool]) -> bool:
    """Whether ``condition`` comes true while the Notifier works."""
    waiting = threading.Event()
    return any(condition() or waiting.wait(0.02) for _ in range(round(PATIENCE_S / 0.02)))


def data_sheet(device: SimulatedServo) -> io.StringIO:
    text = io.StringIO(export_eds(device.dictionary, DeviceIdentity()))
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


@pytest.fixture(scope="module")
def node(runtime: Path) -> Iterator[Any]:  # noqa: ARG001
    options: dict[str, Any] = {"interface": "hub", "channel": "profile", "bitrate": 1_000_000}
    with live_servo(lambda: can.Bus(**options, ignore_config=True), NODE) as device:
        network: Any = canopen.Network()
        network.connect(**options)
        try:
            make: Any = canopen.BaseNode402
            node = make(NODE, data_sheet(device))
            network.add_node(node)
            node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
            node.nmt.state = "OPERATIONAL"
            # Its states come from SDO: it looks for 6041h in TPDOs that are sent without a SYNC.
            node.setup_402_state_machine(False)
            for limit in ("STATE_FINAL", "STATE_SINGLE", "OP_MODE"):
                setattr(node, f"TIMEOUT_SWITCH_{limit}", PATIENCE_S)
            yield node
        finally:
            network.disconnect()


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
    for name in (
        "PROFILED POSITION",
        "PROFILED VELOCITY",
        "PROFILED TORQUE",
        "HOMING",
        "CYCLIC SYNCHRONOUS POSITION",
        "CYCLIC SYNCHRONOUS VELOCITY",
        "CYCLIC SYNCHRONOUS TORQUE",
    ):
        assert node.is_op_mode_supported(name)
        node.op_mode = name
        taken.append(node.op_mode == name)
    assert all(taken)
    assert not node.is_op_mode_supported("INTERPOLATED POSITION")
