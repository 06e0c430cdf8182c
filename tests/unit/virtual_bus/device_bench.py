"""A device under test with a small application, and a master made of raw frames."""

from collections.abc import Sequence
from dataclasses import dataclass

from servobench.drivers.canopen.cob_ids import NO_RTR
from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import DataType, mapping_word
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.device.device_options import DeviceOptions, PdoDefault
from servobench.virtual_bus.device.object_dictionary import Access
from servobench.virtual_bus.device.station import Application, CommunicationLoss, DeviceServices
from servobench.virtual_bus.frame import Frame

NODE = 5
START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130

COUNT = 0x6000
"""UNSIGNED16, ro: the application counts its ``advance`` calls to new instants in it."""
TARGET = 0x6100
"""INTEGER16, rw, -1000..1000."""
LEVEL = 0x6101
"""INTEGER32, rw."""
SWITCHES = 0x6102
"""8 BOOLEANs, rw."""
TRIPLE = 0x6103
"""INTEGER24, rw."""
NOTE = 0x2000
"""DOMAIN, rw."""
SECRET = 0x2001
"""UNSIGNED8, wo."""
RATIO = 0x2002
"""REAL32, rw."""


class RecordingApplication(Application):
    """Notes each call that the engine makes, in order."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []
        self.services: DeviceServices | None = None
        self.advanced_to = Instant(-1)
        self.error_at_reset = 0

    def attach(self, services: DeviceServices) -> None:
        self.services = services
        dictionary = services.dictionary
        self.count = dictionary.add(COUNT, "Count", DataType.UNSIGNED16, Access.READ_ONLY, mappable=True)
        self.target = dictionary.add(
            TARGET,
            "Target",
            DataType.INTEGER16,
            low=-1000,
            high=1000,
            mappable=True,
            on_write=self._on_target,
        )
        self.level = dictionary.add(LEVEL, "Level", DataType.INTEGER32, mappable=True, default=7)
        switches = dictionary.add_array(SWITCHES, "Switches")
        for number in range(1, 9):
            switches.add(number, f"Switch {number}", DataType.BOOLEAN, mappable=True)
        dictionary.add(TRIPLE, "Triple", DataType.INTEGER24, mappable=True)
        self.note = dictionary.add(NOTE, "Note", DataType.DOMAIN)
        dictionary.add(SECRET, "Secret", DataType.UNSIGNED8, Access.WRITE_ONLY)
        dictionary.add(RATIO, "Ratio", DataType.REAL32)

    def _on_target(self, value: int) -> None:
        self.calls.append(("target", value))

    def on_reset(self, now: Instant) -> None:
        self.calls.append(("reset", now))
        if self.error_at_reset and self.services is not None:
            self.services.raise_error(self.error_at_reset, ErrorRegister.GENERIC)

    def advance(self, now: Instant) -> None:
        if now > self.advanced_to:
            self.advanced_to = now
            self.count.value = (self.count.value + 1) % 0x10000

    def on_sync(self, counter: int, now: Instant) -> None:
        self.calls.append(("sync", counter, now))

    def on_nmt(self, state: NmtState, now: Instant) -> None:
        self.calls.append(("nmt", state, now))

    def on_communication_loss(self, cause: CommunicationLoss, node_id: int, now: Instant) -> None:
        self.calls.append(("loss", cause, node_id, now))


DEFAULTS = DeviceOptions(
    rpdos=(
        PdoDefault(0x200, 255, (mapping_word(TARGET, 0, 16), mapping_word(LEVEL, 0, 32))),
        *(PdoDefault(1 << 31 | base, 255) for base in (0x300, 0x400, 0x500)),
    ),
    tpdos=(
        PdoDefault(NO_RTR | 0x180, 1, (mapping_word(COUNT, 0, 16), mapping_word(LEVEL, 0, 32))),
        *(PdoDefault(1 << 31 | NO_RTR | base, 255) for base in (0x280, 0x380, 0x480)),
    ),
)


@dataclass(frozen=True)
class SdoRefused(Exception):
    """The device aborted an access."""

    code: int


class Bench:
    """One device and the instant at which it stands."""

    def __init__(self, options: DeviceOptions = DEFAULTS, start_at: int = 0) -> None:
        self.application = RecordingApplication()
        self.device = CanopenDevice(NODE, self.application, options)
        self.now = Instant(start_at)
        self.sent: list[tuple[int, Frame]] = []
        """All frames of the device, each with its instant."""
        self._note(self.device.start(self.now))

    def _note(self, frames: Sequence[Frame]) -> list[Frame]:
        self.sent += [(self.now, frame) for frame in frames]
        return list(frames)

    def put(self, can_id: int, data: bytes = b"", *, remote: bool = False) -> list[Frame]:
        """A frame on the bus; returns the device's frames in answer."""
        return self._note(self.device.receive(Frame(can_id, data, remote=remote), self.now))

    def run_until_ms(self, milliseconds: float) -> list[tuple[int, Frame]]:
        """Let time pass to an instant; returns the frames that timers sent, with their instants."""
        until, before = Instant(round(milliseconds * NS_PER_MS)), len(self.sent)
        while (due := self.device.wake_at) is not None and due <= until:
            self.now = max(self.now, due)
            self._note(self.device.wake(self.now))
        self.now = until
        return self.sent[before:]

    def act(self) -> None:
        """Bring the device to the present instant, before something is done to it from inside."""
        self._note(self.device.wake(self.now))

    def nmt(self, command: int, node: int = NODE) -> list[Frame]:
        """An NMT command."""
        return self.put(0x000, bytes([command, node]))

    def sync(self, counter: int | None = None) -> list[Frame]:
        """A SYNC."""
        return self.put(0x080, b"" if counter is None else bytes([counter]))

    def request(self, data: bytes) -> bytes:
        """One SDO request; returns the one response."""
        answers = [frame.data for frame in self.put(0x600 + NODE, data) if frame.can_id == 0x580 + NODE]
        assert len(answers) == 1, answers
        return answers[0]

    def write(self, index: int, subindex: int, value: int, length: int) -> None:
        """Expedited download. Error: SdoRefused."""
        command = 0x23 | (4 - length) << 2
        data = (value & (1 << 8 * length) - 1).to_bytes(length, "little").ljust(4, b"\x00")
        answer = self.request(bytes([command]) + index.to_bytes(2, "little") + bytes([subindex]) + data)
        _raise_if_aborted(answer)
        assert answer[0] == 0x60

    def read(self, index: int, subindex: int = 0) -> int:
        """Expedited upload, unsigned. Error: SdoRefused."""
        answer = self.request(bytes([0x40]) + index.to_bytes(2, "little") + bytes([subindex, 0, 0, 0, 0]))
        _raise_if_aborted(answer)
        assert answer[0] & 0xE3 == 0x43
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little")

    def refused(self, index: int, subindex: int, value: int, length: int) -> int:
        """The abort code of a download that must be refused and must leave the value as it was."""
        before = self.read(index, subindex)
        try:
            self.write(index, subindex, value, length)
        except SdoRefused as refusal:
            assert self.read(index, subindex) == before
            return refusal.code
        raise AssertionError(f"{value:#x} was accepted by {index:04X}h:{subindex}")

    def remap(self, communication: int, mapping: int, cob_id: int, kind: int, words: Sequence[int]) -> None:
        """Remap a PDO in the standard's order and switch it on."""
        self.write(communication, 1, self.read(communication, 1) | 1 << 31, 4)
        self.write(mapping, 0, 0, 1)
        for subindex, word in enumerate(words, 1):
            self.write(mapping, subindex, word, 4)
        self.write(mapping, 0, len(words), 1)
        self.write(communication, 2, kind, 1)
        self.write(communication, 1, cob_id, 4)


def _raise_if_aborted(answer: bytes) -> None:
    if answer[0] == 0x80:
        raise SdoRefused(int.from_bytes(answer[4:8], "little"))


def operational(options: DeviceOptions = DEFAULTS) -> Bench:
    """A bench whose device is OPERATIONAL, at instant 0."""
    bench = Bench(options)
    bench.nmt(START)
    return bench
