"""What 1010h keeps of the simulated drive (CiA 301, 7.5.2.13): parameters, and no command or set-point."""

import re
from pathlib import Path

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.parameter_storage import SAVE, MemoryStore
from servobench.virtual_bus.device.sdo_abort import SdoAbort, decode, encode
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING

PAGE = Path(__file__).parents[3] / "docs" / "simulated-drive.md"


def powered(store: MemoryStore) -> SimulatedServo:
    servo = SimulatedServo(1, LING, store=store)
    servo.start(Instant(0))
    return servo


def listed() -> set[int]:
    """The objects that the page says are not kept."""
    (line,) = re.findall(
        r"It keeps all that can be read and written but (.*?)\.\n", PAGE.read_text(), re.DOTALL
    )
    return {int(index, 16) for index in re.findall(r"([0-9A-F]{4})h", line)}


def read_write(servo: SimulatedServo) -> list[Variable]:
    members = [variable for entry in servo.dictionary for variable in entry.members.values()]
    return [variable for variable in members if variable.readable and variable.writable]


def another_value(servo: SimulatedServo, variable: Variable) -> bytes | None:
    """What the bus can set beside the present value, and did; None if nothing else is taken."""
    now = variable.read()
    for value in (now + 1, now - 1, now + 2, now ^ 1 << 31, now + 10, *range(-10, 40)):
        try:
            raw = encode(variable.data_type, value)
            if value == now or decode(variable.data_type, raw) != value:
                continue
            servo.dictionary.download(variable.index, variable.subindex, raw)
        except (SdoAbort, OverflowError):
            continue
        return raw
    return None


def test_every_parameter_survives_save_and_a_restart() -> None:
    store = MemoryStore()
    servo = powered(store)
    kept = [variable for variable in read_write(servo) if variable.index not in listed()]
    kept.reverse()  # 1019h is only taken before the period, 1006h
    changed = [variable for variable in kept if another_value(servo, variable) is not None]
    assert len(changed) > 90, "the mappings of live PDOs, and what has one value only, take no other"
    keys = [(variable.index, variable.subindex) for variable in kept]
    told = {key: servo.dictionary.upload(*key) for key in keys}
    servo.dictionary.download(0x1010, 1, SAVE.to_bytes(4, "little"))
    again = powered(store).dictionary
    assert {key: again.upload(*key) for key in keys} == told


def test_no_command_and_no_set_point_does() -> None:
    store = MemoryStore()
    servo = powered(store)
    before = {}
    for variable in read_write(servo):
        if variable.index in listed() and variable.index not in (0x1010, 0x1011):
            key = variable.index, variable.subindex
            before[key] = variable.default
            another_value(servo, variable)
    servo.dictionary.download(0x1010, 1, SAVE.to_bytes(4, "little"))
    assert not before.keys() & store.load().keys()
    assert len(before) > 10


def test_a_stored_limit_acts_after_the_restart() -> None:
    store = MemoryStore()
    servo = powered(store)
    servo.dictionary.download(Object.MAX_TORQUE, 0, (100).to_bytes(2, "little"))
    servo.dictionary.download(0x1010, 3, SAVE.to_bytes(4, "little"))
    after = powered(store)
    after.dictionary.download(Object.TARGET_TORQUE, 0, (500).to_bytes(2, "little"))
    for index, value in ((0x6040, 6), (0x6040, 7), (0x6040, 15)):
        after.dictionary.download(index, 0, value.to_bytes(2, "little"))
    assert after.drive.firmware.torque_demand_nm == pytest.approx(0.1 * LING.rated_torque_nm, rel=0.02)


def test_a_stored_limit_that_the_drive_cannot_have_is_left_alone() -> None:
    store = MemoryStore()
    store.save({(int(Object.MAX_TORQUE), 0): b"\xff\xff"})
    variable = powered(store).dictionary.variable(Object.MAX_TORQUE)
    assert variable.value == variable.default
