"""python canopen as it is, with its own network and Notifier thread, as master of ``hil simulate``."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import canopen
import pytest

from tests.scenario.processes import serving

NODE, OTHER = 1, 9
PATIENCE_S = 20.0
EDS = Path(__file__).parent / "rehearsed.eds"
NOTE, STATUSWORD, TARGET_TORQUE = 0x2000, 0x6041, 0x6071


def eventually(condition: Callable[[], bool]) -> bool:
    """Whether ``condition`` comes true while the Notifier works."""
    waiting = threading.Event()
    return any(condition() or waiting.wait(0.02) for _ in range(round(PATIENCE_S / 0.02))) or condition()


class MasterSuite:
    """A subclass says on which bus: ``bus_spec`` for hil, ``connection`` for python-can."""

    @pytest.fixture
    def network(self, connection: dict[str, Any]) -> Iterator[Any]:
        network: Any = canopen.Network()
        network.connect(**connection)
        yield network
        network.disconnect()

    def node(self, network: Any, number: int = NODE) -> Any:
        node = canopen.RemoteNode(number, str(EDS))
        node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        network.add_node(node)
        return node

    def test_sdo_by_all_transfers_both_ways(self, bus_spec: str, network: Any, tmp_path: Path) -> None:
        store = str(tmp_path / "drive.json")
        options = ("--node", str(NODE), "--eds", str(EDS), "--store", store)
        content = bytes(number * 7 & 0xFF for number in range(2000))
        with serving(["simulate", "--bus", bus_spec, *options]):
            node = self.node(network)
            node.sdo[0x1017].raw = 20
            node.sdo[NOTE].raw = b"by segments, both ways"
            assert node.sdo[NOTE].raw == b"by segments, both ways"
            with node.sdo[NOTE].open("wb", size=len(content), block_transfer=True) as stream:
                stream.write(content)
            with node.sdo[NOTE].open("rb", block_transfer=True) as stream:
                assert stream.read() == content
            assert node.nmt.wait_for_heartbeat(PATIENCE_S) == "PRE-OPERATIONAL"
            with pytest.raises(canopen.SdoAbortedError, match="0x06020000"):
                node.sdo.upload(0x1029, 1)
            node.sdo[0x1010][1].raw = int.from_bytes(b"save", "little")
        with serving(["simulate", "--bus", bus_spec, *options]):
            assert self.node(network).sdo[0x1017].raw == 20

    def test_remapped_tpdo_by_sync_and_emcy(self, bus_spec: str, network: Any) -> None:
        with serving(["simulate", "--bus", bus_spec, "--node", str(NODE), "--eds", str(EDS)]):
            node = self.node(network)
            node.tpdo.read()
            node.rpdo.read()
            assert [variable.index for variable in node.tpdo[1].map] == [STATUSWORD]
            pdo = node.tpdo[1]
            pdo.clear()
            pdo.add_variable(STATUSWORD)
            pdo.add_variable(TARGET_TORQUE)
            pdo.cob_id, pdo.trans_type, pdo.enabled = 0x3A0 + NODE, 1, True
            pdo.save()
            node.nmt.state = "OPERATIONAL"
            node.rpdo[1][TARGET_TORQUE].raw = 123
            node.rpdo[1].transmit()
            network.sync.start(0.01)
            assert eventually(lambda: pdo.is_received and pdo[TARGET_TORQUE].raw == 123)
            network.sync.stop()
            network.send_message(0x200 + NODE, b"\x01")
            assert eventually(lambda: [error.code for error in node.emcy.active] == [0x8210])

    def test_lss_finds_and_configures(self, bus_spec: str, network: Any) -> None:
        with serving(["simulate", "--bus", bus_spec, "--node", "unconfigured"]):
            lss = network.lss
            found, identity = lss.fast_scan()
            assert found
            lss.configure_node_id(OTHER)
            lss.store_configuration()
            node = self.node(network, OTHER)
            lss.send_switch_state_global(lss.WAITING_STATE)
            assert eventually(lambda: node.nmt.state == "PRE-OPERATIONAL")  # by its boot-up message
            assert node.sdo[0x1018][2].raw == identity[1]
            assert lss.send_switch_state_selective(*identity)
            assert lss.inquire_node_id() == OTHER
