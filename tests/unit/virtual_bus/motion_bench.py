"""The simulated drive on a desk in one of its modes of motion; all by frames, in turns of the shaft."""

from collections.abc import Callable, Sequence
from struct import pack

from servobench.design.motor import PmsmParameters
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, State, Status
from servobench.virtual_bus.drive.machine import MACHINE
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.motors import LING
from tests.unit.virtual_bus.servo_bench import ServoBench

COUNTS = 65_536
RPM_PER_TURN_S = 60
ENABLED = 0x0F
NEW_SET_POINT, AT_ONCE, RELATIVE, HALT, ON_SET_POINT = 0x10, 0x20, 0x40, 0x100, 0x200
REACHED, LIMITED, BIT_12, BIT_13 = (
    Status.TARGET_REACHED,
    Status.INTERNAL_LIMIT_ACTIVE,
    Status.MODE_12,
    Status.MODE_13,
)
INPUTS_HELD, SWITCHES, NEGATIVE, POSITIVE, HOME_FROM, HOME_TO, INDEX, STO = range(1, 9)
"""Sub-indices of the simulated machine."""


class MotionBench(ServoBench):
    """Set-points in turns, turns/s and turns/s^2; RPDO2 carries a controlword and 607Ah, RPDO3 60FFh."""

    def __init__(
        self,
        mode: Mode,
        drive: DriveParameters | None = None,
        *,
        enabled: bool = True,
        motor: PmsmParameters = LING,
    ) -> None:
        super().__init__(drive, motor=motor)
        self.set(Object.MODES_OF_OPERATION, "b", mode)
        if enabled:
            self.enable()

    def enable(self) -> None:
        for controlword in (0x06, 0x07, ENABLED):
            self.control(controlword)
        assert self.state is State.OPERATION_ENABLED
        self.wait_ms(20)

    def set(self, index: int, code: str, value: int, subindex: int = 0) -> None:
        """An SDO download that must be taken."""
        abort = self.write(index, code, value, subindex)
        assert abort is None, f"{index:04X}h:{subindex} = {value}: {abort:08X}h"

    def control(self, controlword: int) -> None:
        """By SDO, and an inner period for the drive to act."""
        self.set(Object.CONTROLWORD, "H", controlword)
        self.wait_ms(0.1)

    # ---- set-points -----------------------------------------------------------------------------------

    def profile(self, speed: float, acceleration: float, deceleration: float) -> None:
        """turns/s, turns/s^2."""
        self.set(Object.PROFILE_VELOCITY, "I", round(speed * RPM_PER_TURN_S * 1000))
        self.set(Object.PROFILE_ACCELERATION, "I", round(acceleration * RPM_PER_TURN_S))
        self.set(Object.PROFILE_DECELERATION, "I", round(deceleration * RPM_PER_TURN_S))

    def target(self, turns: float, flags: int = 0, controlword: int = ENABLED) -> None:
        """607Ah, and the hand-shake of PP."""
        self.set(Object.TARGET_POSITION, "i", round(turns * COUNTS))
        self.control(controlword | NEW_SET_POINT | flags)
        assert self.statusword & BIT_12, "set-point acknowledge"
        self.control(controlword | flags)

    def speed(self, turns_s: float) -> None:
        """60FFh."""
        self.set(Object.TARGET_VELOCITY, "i", round(turns_s * RPM_PER_TURN_S * 1000))

    def fit(self, switches: int, **places: float) -> None:
        """Fit switches, bits as in 60FDh, at places in turns."""
        names = {"negative": NEGATIVE, "positive": POSITIVE, "home_from": HOME_FROM, "home_to": HOME_TO}
        for name, turns in places.items():
            self.set(MACHINE, "i", round(turns * COUNTS), names[name])
        self.set(MACHINE, "B", switches, SWITCHES)

    # ---- what the drive says --------------------------------------------------------------------------

    @property
    def turns(self) -> float:
        """6064h."""
        return self.read(Object.POSITION_ACTUAL_VALUE, "i") / COUNTS

    @property
    def turns_s(self) -> float:
        """606Ch."""
        return self.read(Object.VELOCITY_ACTUAL_VALUE, "i") / RPM_PER_TURN_S / 1000

    @property
    def inputs(self) -> int:
        """60FDh."""
        return self.read(Object.DIGITAL_INPUTS, "I")

    @property
    def reached(self) -> bool:
        """Bit 10."""
        return bool(self.statusword & REACHED)

    def until_reached(self, limit_ms: int = 3000) -> int:
        """Milliseconds until bit 10 is set."""
        return self.wait_until(lambda: self.reached, limit_ms)

    def watch(self, milliseconds: int, seen: Callable[[], float]) -> list[float]:
        """``seen`` after each of so many milliseconds."""
        values = []
        for _ in range(milliseconds):
            self.wait_ms(1)
            values.append(seen())
        return values

    def emergencies(self) -> list[int]:
        """Error codes of the EMCYs so far."""
        return [int.from_bytes(frame.data[:2], "little") for frame in self.sent if frame.can_id == 0x81]

    def map_rpdo(self, number: int, *words: int, kind: int = 255) -> None:
        """Map RPDO ``number`` by the standard's procedure; it acts on arrival unless ``kind`` says else."""
        cob_id = 0x100 * (number + 1) + 1
        self._map(0x1400 + number - 1, 0x1600 + number - 1, cob_id, kind, words)

    def map_tpdo(
        self, number: int, *words: int, kind: int = 255, inhibit_ms: float = 0.0, event_ms: int = 0
    ) -> None:
        """Map TPDO ``number`` likewise."""
        parameter = 0x1800 + number - 1
        cob_id = 0x4000_0000 | 0x80 + 0x100 * number + 1
        self.set(parameter, "I", 0x8000_0000 | cob_id, 1)
        self.set(parameter, "H", round(inhibit_ms * 10), 3)
        self.set(parameter, "H", event_ms, 5)
        self._map(parameter, 0x1A00 + number - 1, cob_id, kind, words)

    def _map(self, parameter: int, mapping: int, cob_id: int, kind: int, words: Sequence[int]) -> None:
        self.set(parameter, "I", 0x8000_0000 | cob_id, 1)
        self.set(mapping, "B", 0, 0)
        for place, word in enumerate(words, start=1):
            self.set(mapping, "I", word, place)
        self.set(mapping, "B", len(words), 0)
        self.set(parameter, "B", kind, 2)
        self.set(parameter, "I", cob_id, 1)

    def send(self, number: int, layout: str, *values: int) -> None:
        """RPDO ``number``."""
        self.receive(Frame(0x100 * (number + 1) + 1, pack("<" + layout, *values)))
