"""A simulated drive on a desk: frames in, frames out, time by hand; for the tests of the drive."""

import struct
from collections.abc import Callable

from servobench.design.motor import PmsmParameters
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import CONTROLWORDS, DriveCommand, State, state_of
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.motors import LING

SYNC = Frame(0x80)
ENABLE = (DriveCommand.SHUTDOWN, DriveCommand.SWITCH_ON, DriveCommand.ENABLE_OPERATION)


class ServoBench:
    """Node 1 on [Ling2012]'s motor, powered on and OPERATIONAL, fed frame by frame."""

    def __init__(
        self, drive: DriveParameters | None = None, seed: int = 1, motor: PmsmParameters = LING
    ) -> None:
        self.now = Instant(0)
        self.sent: list[Frame] = []
        self._drive, self._seed, self._motor = drive, seed, motor
        self.power_on()

    def power_on(self, vendor: Callable[[ObjectDictionary], None] | None = None) -> None:
        """A drive in the place of the one before, if there was one."""
        self.servo = SimulatedServo(1, self._motor, self._drive, self._seed, vendor=vendor)
        self.sent += self.servo.start(self.now)
        self.nmt(1)

    def wait_ms(self, milliseconds: float) -> None:
        """Let time pass, with every wake that the device asks for."""
        end = self.now + round(milliseconds * NS_PER_MS)
        while (due := self.servo.wake_at) is not None and due <= end:
            self.now = max(self.now, due)
            self.sent += self.servo.wake(self.now)
        self.now = Instant(end)
        self.sent += self.servo.wake(self.now)

    def wait_until(self, condition: Callable[[], bool], limit_ms: int) -> int:
        """Milliseconds until ``condition``; fails the test at ``limit_ms``."""
        for passed in range(limit_ms):
            if condition():
                return passed
            self.wait_ms(1)
        raise AssertionError(f"still {self.state} after {limit_ms} ms")

    def receive(self, frame: Frame) -> list[Frame]:
        """A frame for the device, and its answers at once."""
        answers = list(self.servo.receive(frame, self.now))
        self.sent += answers
        return answers

    def nmt(self, command: int) -> list[Frame]:
        return self.receive(Frame(0x000, bytes([command, 1])))

    def rpdo(self, controlword: int, torque_raw: int = 0) -> None:
        """Controlword and target torque, then one inner period and more."""
        self.receive(Frame(0x201, struct.pack("<Hh", controlword, torque_raw)))
        self.wait_ms(0.2)

    def command(self, *commands: DriveCommand, torque_raw: int = 0) -> None:
        for command in commands:
            self.rpdo(CONTROLWORDS[command], torque_raw)

    def sync(self) -> list[Frame]:
        return self.receive(SYNC)

    def write(self, index: int, code: str, value: int, subindex: int = 0) -> int | None:
        """SDO download; the abort code, or None."""
        raw = struct.pack("<" + code, value)
        head = struct.pack("<BHB", 0x23 | (4 - len(raw)) << 2, index, subindex)
        answer = self._ask(head + raw.ljust(4, b"\x00"))
        if answer.data[0] == 0x80:
            return int.from_bytes(answer.data[4:], "little")
        assert answer.data[0] == 0x60
        return None

    def read(self, index: int, code: str, subindex: int = 0) -> int:
        """SDO upload of an integer."""
        answer = self._ask(struct.pack("<BHB4x", 0x40, index, subindex))
        assert answer.data[0] & 0xE3 == 0x43, answer.data.hex()
        size = struct.calcsize("<" + code)
        assert size == 4 - (answer.data[0] >> 2 & 3)
        return int(struct.unpack_from("<" + code, answer.data, 4)[0])

    def _ask(self, request: bytes) -> Frame:
        """The SDO server's one answer; an EMCY may go out beside it."""
        (answer,) = [frame for frame in self.receive(Frame(0x601, request)) if frame.can_id == 0x581]
        return answer

    @property
    def statusword(self) -> int:
        """As in TPDO1."""
        return int(self.servo.dictionary.variable(Object.STATUSWORD).value)

    @property
    def state(self) -> State | None:
        """As the statusword tells it."""
        return state_of(self.statusword)

    def shows(self, state: State) -> bool:
        """Whether the statusword tells ``state``."""
        return self.state is state

    @property
    def speed_rad_s(self) -> float:
        """True speed of the shaft."""
        return self.servo.drive.firmware.speed_rad_s

    def turn(self, milliseconds: int = 60, torque_raw: int = 800) -> None:
        """Enable the drive and bring the shaft to speed: 800 are 1.6 N m."""
        self.command(*ENABLE, torque_raw=torque_raw)
        assert self.state is State.OPERATION_ENABLED
        self.wait_ms(milliseconds)
