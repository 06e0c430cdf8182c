"""A master of raw frames on any python-can bus, for one device under test.

An order of frames ends with a remote request of node guarding (CiA 301, 7.2.8.2.2.1), which the device
answers in every state and after all that it sends before: what has not come until then does not come.
"""

from dataclasses import dataclass

import can

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.wire.message import frame_of
from servobench.virtual_bus.frame import Frame

NODE = 5
GUARD = 0x700 + NODE
BOOT_UP = Frame(GUARD, b"\x00")
SDO_REQUEST, SDO_RESPONSE = 0x600 + NODE, 0x580 + NODE
PATIENCE_S = 20.0
START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
STATE_COMMANDS = {
    NmtState.PRE_OPERATIONAL: PRE_OPERATIONAL,
    NmtState.OPERATIONAL: START,
    NmtState.STOPPED: STOP,
}


@dataclass(frozen=True)
class Aborted(Exception):
    """The device aborted an SDO transfer."""

    code: int


class Rig:
    """The bus, and what the device under test says on it."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def send(self, can_id: int, data: bytes = b"", *, remote: bool = False, extended: bool = False) -> None:
        """One frame; a remote one asks for one byte."""
        self._bus.send(
            can.Message(
                arbitration_id=can_id,
                data=None if remote else data,
                dlc=1 if remote else len(data),
                is_remote_frame=remote,
                is_extended_id=extended,
            ),
            timeout=PATIENCE_S,
        )

    def receive(self, timeout_s: float = PATIENCE_S) -> tuple[Frame, float]:
        """The next frame of the device and its stamp, s. Error: AssertionError if none comes."""
        message = self._bus.recv(timeout_s)
        assert message is not None, "the device is silent"
        return frame_of(message), message.timestamp

    def wait_for(self, can_id: int) -> tuple[Frame, float]:
        """The next frame with ``can_id``."""
        while True:
            frame, stamp = self.receive()
            if frame.can_id == can_id:
                return frame, stamp

    def pause(self, duration_s: float) -> list[Frame]:
        """All that the device sends of itself for so long."""
        frames: list[Frame] = []
        while (message := self._bus.recv(duration_s)) is not None:
            frames.append(frame_of(message))
        return frames

    def ask(self, can_id: int, data: bytes = b"", *, remote: bool = False) -> list[Frame]:
        """All that the device answers to one frame."""
        self.send(can_id, data, remote=remote)
        return self.fence()[0]

    def fence(self) -> tuple[list[Frame], NmtState]:
        """What the device has sent until it answers a node guarding request, and the state it tells."""
        self.send(GUARD, remote=True)
        frames: list[Frame] = []
        while True:
            frame, _stamp = self.receive()
            if frame.can_id == GUARD and frame.data != b"\x00":
                return frames, NmtState(frame.data[0] & 0x7F)
            frames.append(frame)

    @property
    def state(self) -> NmtState:
        """The device's NMT state."""
        return self.fence()[1]

    def nmt(self, command: int, node: int = NODE) -> list[Frame]:
        """An NMT command and what comes of it; after a reset the device is left to boot first."""
        resets = command in (RESET_NODE, RESET_COMMUNICATION)
        if resets:
            self.fence()  # the boot-up of power-on is none that answers
        self.send(0x000, bytes([command, node]))
        came: list[Frame] = []
        while resets and BOOT_UP not in came:
            came.append(self.receive()[0])
        return came + self.fence()[0]

    def enter(self, state: NmtState) -> None:
        """Go to ``state``."""
        self.nmt(STATE_COMMANDS[state])
        assert self.state is state

    def sdo(self, request: bytes) -> bytes:
        """One SDO request and its one response, at once."""
        answers = [frame.data for frame in self.ask(SDO_REQUEST, request) if frame.can_id == SDO_RESPONSE]
        assert len(answers) == 1, f"{len(answers)} responses to {request.hex()}"
        return answers[0]

    def read(self, index: int, subindex: int = 0) -> bytes:
        """An upload, expedited or segmented. Error: Aborted."""
        answer = self.checked(self.sdo(initiate(0x40, index, subindex)))
        if answer[0] & 2:
            return answer[4 : 8 - (answer[0] >> 2 & 3)]
        data, toggle, last = b"", 0, False
        while not last:
            segment = self.checked(self.sdo(bytes([0x60 | toggle]) + bytes(7)))
            assert segment[0] & 0xF0 == toggle
            data += segment[1 : 8 - (segment[0] >> 1 & 7)]
            toggle, last = toggle ^ 0x10, bool(segment[0] & 1)
        assert len(data) == int.from_bytes(answer[4:8], "little")
        return data

    def number(self, index: int, subindex: int = 0) -> int:
        """An upload of an unsigned number."""
        return int.from_bytes(self.read(index, subindex), "little")

    def write(self, index: int, subindex: int, value: int, length: int) -> None:
        """An expedited download. Error: Aborted."""
        data = value.to_bytes(length, "little").ljust(4, b"\x00")
        answer = self.checked(self.sdo(initiate(0x23 | (4 - length) << 2, index, subindex, data)))
        assert answer == initiate(0x60, index, subindex)

    def refusal(self, index: int, subindex: int, value: int, length: int) -> int:
        """The abort code of a download that must be refused and must change nothing."""
        before = self._read_or_code(index, subindex)
        try:
            self.write(index, subindex, value, length)
        except Aborted as aborted:
            assert self._read_or_code(index, subindex) == before
            return aborted.code
        raise AssertionError(f"{value:#x} was accepted by {index:04X}h:{subindex}")

    def _read_or_code(self, index: int, subindex: int) -> bytes | int:
        try:
            return self.read(index, subindex)
        except Aborted as aborted:
            return aborted.code

    @staticmethod
    def checked(answer: bytes) -> bytes:
        """``answer`` if it is no abort. Error: Aborted."""
        if answer[0] == 0x80:
            raise Aborted(int.from_bytes(answer[4:8], "little"))
        return answer

    def remap(self, number: int, cob_id: int, kind: int, words: tuple[int, ...], *, transmit: bool) -> None:
        """Remap PDO ``number`` in the standard's order and switch it on."""
        communication = (0x1800 if transmit else 0x1400) + number - 1
        mapping = communication + 0x200
        self.write(communication, 1, 1 << 31 | self.number(communication, 1), 4)
        self.write(mapping, 0, 0, 1)
        for subindex, word in enumerate(words, 1):
            self.write(mapping, subindex, word, 4)
        self.write(mapping, 0, len(words), 1)
        self.write(communication, 2, kind, 1)
        self.write(communication, 1, cob_id, 4)


def initiate(command: int, index: int, subindex: int, data: bytes = b"") -> bytes:
    """An SDO initiate message."""
    return bytes([command]) + index.to_bytes(2, "little") + bytes([subindex]) + data.ljust(4, b"\x00")
