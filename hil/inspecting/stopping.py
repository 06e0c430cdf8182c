"""``hil stop``: every drive of a bus to rest and disabled, whoever else commands it.

at once       each node that is asked for, or that tells a statusword, gets a quick stop by SDO
again         until its statusword and its position say that it is at rest; then its voltage is disabled
re-enabled    it goes to PRE-OPERATIONAL, in which it takes SDOs, but no RPDO of another master any more
              (CiA 301 7.3.2.2.6); from there as before
silent        PRE-OPERATIONAL, and at last STOPPED: what comes of it is the drive's (6007h)

No heartbeat is sent: another master may have the same node-ID.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

from servobench.drivers.canopen.bus_scan import NODES
from servobench.drivers.canopen.cob_ids import SDO_ANSWER
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtCommand
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import CONTROLWORDS, DriveCommand, State, state_of
from servobench.drivers.errors import BusDown, NoAnswer, PeerFault, TransferAborted
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, duration_s

_LIMIT: Final = Duration(5 * NS_PER_S)
"""A drive with its own ramp takes seconds."""
_ROUND: Final = Duration(20 * NS_PER_MS)
_REST_ROUNDS: Final = 10
"""After being at rest and disabled for this long, a master that enables it again has shown."""
_REST_UNITS: Final = 2
"""An encoder may jump to and fro."""
_PATIENCE: Final = 3
"""Rounds in which a quick stop by SDO has no effect, or nothing is answered, before NMT is used."""
_ASK_EVERY: Final = Duration(NS_PER_MS)
"""A frame of eight bytes takes 1 ms at 125 kbit/s."""
_SDO_TIMEOUT_S: Final = 0.05
"""Somebody waits for drives to stop: who is silent for so long is stopped by NMT."""
_ASK_WAIT: Final = duration_s(_SDO_TIMEOUT_S)
"""After the last node was asked; an answer is waited for as long as any other."""
_WORD: Final = 1 << 32
"""6064h is an INTEGER32."""
_UPLOAD: Final = 0x40
"""Initiate upload, CiA 301 7.2.4.3.4."""
_DOWNLOAD_TWO_BYTES: Final = 0x2B
"""Expedited, with its size told: CiA 301 7.2.4.3.3."""
_UPLOADED: Final = 2
"""Server command specifier of initiate upload, CiA 301 7.2.4.3.4."""
_ENABLING: Final = (State.READY, State.SWITCHED_ON, State.OPERATION_ENABLED)
_DISABLED: Final = (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY)


class NodeStopped(NamedTuple):
    """Result for one node."""

    node: int
    at_rest: bool
    """Its position stands still, and it is disabled or in fault."""
    before: str
    """Its state at the first query; empty if unknown."""
    after: str
    took_ms: float
    text: str
    """Description, with measures beyond a quick stop."""


class _Stop:
    """The stop of one node, round by round."""

    def __init__(self, network: CanopenNetwork, node: int, began: Instant, before: State | None) -> None:
        self.node = node
        self.done = False
        self._network = network
        self._began = began
        self._before = before
        self._asked = False
        self._state: State | None = None
        self._position: int | None = None
        self._calm = self._enabling = self._silent = 0
        self._means: list[str] = []
        self._ended = self._began

    def round(self) -> None:
        """Check the node, and repeat outstanding commands. Raises BusDown."""
        try:
            self._look()
            self._silent = 0
            self._act()
        except BusDown:
            raise
        except PeerFault:
            self._on_silence()

    def result(self) -> NodeStopped:
        """Return the result so far."""
        named = "" if self._state is None else self._state.value
        before = "" if self._before is None else self._before.value
        if not self._asked:
            text = "it answers no SDO"
        elif self.done:
            text = "at rest and in fault" if self._state is State.FAULT else "at rest and disabled"
            text += " already" if before == named and not self._means else ""
        else:
            text = f"NOT known to be at rest: {named or 'unknown state'}"
        text = "; ".join([text, *self._means])
        took_ms = (self._ended - self._began) / NS_PER_MS
        return NodeStopped(self.node, self.done, before, named, took_ms, text)

    # ---- inside ---------------------------------------------------------------------------------------

    def _look(self) -> None:
        self._state = state_of(self._read(Object.STATUSWORD))
        if not self._asked:
            self._asked, self._before = True, self._before or self._state
        rests = self._stands_still() and self._state in _DISABLED
        if not rests or not self._calm:
            self._ended = self._network.clock.now()
        self._calm = self._calm + 1 if rests else 0
        self.done = self._calm >= _REST_ROUNDS

    def _act(self) -> None:
        if self._state in _ENABLING:
            self._enabling += 1
            if self._enabling > _PATIENCE:
                self._command(NmtCommand.ENTER_PRE_OPERATIONAL, "it was enabled again, or took no quick stop")
        if self._state is State.OPERATION_ENABLED:
            self._write(DriveCommand.QUICK_STOP)
        elif self._state in _ENABLING or self._state is None:
            self._write(DriveCommand.DISABLE_VOLTAGE)
        elif self._state is State.QUICK_STOP:
            self._network.pump(self._network.deadline_after(_ROUND))
            if self._stands_still():
                self._write(DriveCommand.DISABLE_VOLTAGE)  # 605Ah = 5 to 8 stay in it

    def _stands_still(self) -> bool:
        """Return True if its position has not changed since the last read; unknown for a drive without
        one."""
        before = self._position
        try:
            self._position = self._read(Object.POSITION_ACTUAL_VALUE)
        except TransferAborted:
            self._position = None
        if before is None or self._position is None:
            return False
        return _apart(before, self._position) <= _REST_UNITS

    def _on_silence(self) -> None:
        self._silent += 1
        self._calm = 0
        if self._silent == _PATIENCE:
            self._command(NmtCommand.ENTER_PRE_OPERATIONAL, "it did not answer")
        elif self._silent == 2 * _PATIENCE:
            self._command(NmtCommand.STOP, "it did not answer")

    def _command(self, command: NmtCommand, why: str) -> None:
        self._network.command(command, self.node)
        text = f"NMT {command.name.lower().replace('_', ' ')}, as {why}"
        if text not in self._means:
            self._means.append(text)

    def _read(self, index: int) -> int:
        data = self._network.upload(self.node, index, timeout_s=_SDO_TIMEOUT_S, attempts=1)
        return int.from_bytes(data, "little")

    def _write(self, command: DriveCommand) -> None:
        self._network.download(self.node, Object.CONTROLWORD, 0, CONTROLWORDS[command].to_bytes(2, "little"))


def _apart(one: int, other: int) -> int:
    """Return the difference of two positions of 32 bits, which may wrap."""
    return min((one - other) % _WORD, (other - one) % _WORD)


def stop_drives(network: CanopenNetwork, nodes: Sequence[int]) -> list[NodeStopped]:
    """Bring ``nodes`` to rest and disable them; without any, all that report a statusword.

    Raises NoAnswer if none does, BusDown if the bus goes away.
    """
    network.sdo_timeout_s = _SDO_TIMEOUT_S
    began = network.clock.now()
    states = _stop_at_once(network, nodes)
    stops = [_Stop(network, node, began, states.get(node)) for node in nodes or sorted(states)]
    if not stops:
        raise NoAnswer(
            f"no drive on {network.link.name} answers",
            "no node has told its statusword, 6041h",
            "a drive that does not answer is stopped at its supply; hil scan shows who is there",
        )
    deadline = network.deadline_after(_LIMIT)
    while network.clock.now() < deadline and not all(stop.done for stop in stops):
        due = network.deadline_after(_ROUND)
        for stop in stops:
            stop.round()
        network.pump(due)
    return [stop.result() for stop in stops]


def _stop_at_once(network: CanopenNetwork, nodes: Sequence[int]) -> dict[int, State | None]:
    """Ask each node for its statusword, and answer with a quick stop, without waiting. Return the reported
    states.

    A node that has shown no statusword gets none: 6040h of another device may be anything.
    """
    told: dict[int, State | None] = {}

    def listen(node: int) -> None:
        def heard(data: bytes, _at: Instant) -> None:
            if len(data) != len(_ASK) or data[0] >> 5 != _UPLOADED or data[1:4] != _ASK[1:4] or node in told:
                return
            told[node] = state_of(int.from_bytes(data[4:6], "little"))
            if told[node] not in _DISABLED:
                network.send_request(node, _QUICK_STOP)

        network.listen(SDO_ANSWER + node, heard)

    for node in nodes or NODES:
        listen(node)
        network.send_request(node, _ASK)
        network.pump(network.deadline_after(_ASK_EVERY))
    network.pump(network.deadline_after(_ASK_WAIT))
    for node in nodes or NODES:
        network.unlisten(SDO_ANSWER + node)
    return told


def _request(specifier: int, index: int, data: bytes = b"") -> bytes:
    return (bytes((specifier, index & 0xFF, index >> 8, 0)) + data).ljust(8, b"\0")


_ASK: Final = _request(_UPLOAD, Object.STATUSWORD)
_QUICK_STOP: Final = _request(
    _DOWNLOAD_TWO_BYTES, Object.CONTROLWORD, CONTROLWORDS[DriveCommand.QUICK_STOP].to_bytes(2, "little")
)
