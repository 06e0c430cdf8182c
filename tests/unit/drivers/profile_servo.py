"""The scripted node with the profile modes and homing of CiA 402-2: hand-shakes and times, no motor."""

from servobench.drivers.cia402.profile import Mode, State
from servobench.drivers.timebase import NS_PER_MS
from tests.unit.drivers.fake_bus import FakeBus, FakeServo

REACHED, ACKNOWLEDGED, FAILED = 1 << 10, 1 << 12, 1 << 13
TYPES = {
    (0x6062, 0): "i",
    (0x607A, 0): "i",
    (0x607C, 0): "i",
    (0x6081, 0): "I",
    (0x6083, 0): "I",
    (0x6084, 0): "I",
    (0x6087, 0): "I",
    (0x6098, 0): "b",
    (0x6099, 1): "I",
    (0x6099, 2): "I",
    (0x609A, 0): "I",
    (0x60FF, 0): "i",
}


class ProfileServo(FakeServo):
    """Takes every move and finishes it after ``move_ns``."""

    def __init__(self, bus: FakeBus) -> None:
        super().__init__(bus)
        self.types |= TYPES
        self.values |= dict.fromkeys(TYPES, 0)
        self.values[0x6502, 0] = 0x3AD | 0x200
        self.moves: list[tuple[int, bool, bool]] = []
        """Target, relative, at once; of each set-point that was taken."""
        self.modes: list[tuple[int, int]] = []
        """Each mode that was taken up, with the controlword of that moment."""
        self.deaf_to_set_points = False
        self.home_fails = False
        self.ack_ns, self.move_ns, self.mode_ns = NS_PER_MS, 20 * NS_PER_MS, 3 * NS_PER_MS
        self._word = 0

    def _written(self, index: int) -> None:
        mode = self.values[0x6060, 0]
        if index == 0x6060:
            if mode != self.values[0x6061, 0]:
                self.bus.call_after(self.mode_ns, self._take_up)
            return
        super()._written(index)
        if index == 0x6040:
            self._bits(self._word, self.values[0x6040, 0])
            self._word = self.values[0x6040, 0]
        elif (index, self.values[0x6061, 0]) in (
            (0x60FF, Mode.PROFILE_VELOCITY),
            (0x6071, Mode.PROFILE_TORQUE),
        ):
            self._start(0x606C if index == 0x60FF else 0x6077, self.values[index, 0])

    def _take_up(self) -> None:
        mode = self.values[0x6060, 0]
        if mode != self.values[0x6061, 0]:
            self.modes.append((mode, self.values[0x6040, 0]))
            self.values[0x6061, 0] = mode
            self.mode_status = 0

    def _bits(self, before: int, word: int) -> None:
        rose = word & ~before
        if self.state is not State.OPERATION_ENABLED:
            return
        mode = self.values[0x6061, 0]
        if rose & 0x100:
            self.mode_status &= ~REACHED
            self.bus.call_after(self.move_ns, self._reach)
        if mode == Mode.PROFILE_POSITION and rose & 0x10 and not self.deaf_to_set_points:
            self._take_set_point(bool(word & 0x40), bool(word & 0x20))
        elif mode == Mode.PROFILE_POSITION and not word & 0x10:
            self.mode_status &= ~ACKNOWLEDGED
        elif mode == Mode.HOMING and rose & 0x10:
            self.mode_status = 0
            self.bus.call_after(self.move_ns, self._home)

    def _take_set_point(self, relative: bool, at_once: bool) -> None:
        target = self.values[0x607A, 0]
        self.moves.append((target, relative, at_once))
        self.bus.call_after(self.ack_ns, self._acknowledge)
        self._start(0x6064, target + (self.values[0x6064, 0] if relative else 0))

    def _acknowledge(self) -> None:
        self.mode_status |= ACKNOWLEDGED

    def _start(self, index: int, value: int) -> None:
        self.mode_status &= ~REACHED

        def arrive() -> None:
            self.values[index, 0] = value
            self._reach()

        self.bus.call_after(self.move_ns, arrive)

    def _reach(self) -> None:
        self.mode_status |= REACHED

    def _home(self) -> None:
        self.mode_status = FAILED if self.home_fails else REACHED | ACKNOWLEDGED
        self.values[0x6064, 0] = self.values[0x607C, 0]
