"""Drives that are drawn, and what a drive says and does under a master who does whatever comes to mind."""

import dataclasses
from pathlib import Path
from random import Random
from typing import Final
from zlib import crc32

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import CONTROLWORDS, DriveCommand, Mode
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from servobench.virtual_bus.frame import Frame
from tests.draws import few_of
from tests.told import hold
from tests.unit.virtual_bus.servo_bench import ENABLE, ServoBench

TOLD: Final = Path(__file__).with_name("told")


def test_drawn_drives_are_told() -> None:
    lines = []
    for seed in range(12):
        servo, truth = unknown_drive(seed, drive=DriveParameters(clock_drift_ppm=float(seed)))
        drawn = dataclasses.asdict(truth) | {"faults": sorted(truth.faults)}
        lines += [f"== {seed}", *(f"{key} {value}" for key, value in drawn.items()), str(truth.nameplate)]
        for entry in servo.dictionary:
            if entry.index >= 0x6000:
                lines += [f"{entry.index:04X}h:{sub} {each.read()}" for sub, each in entry.members.items()]
    hold("\n".join(lines), TOLD / "drawn_drives.txt")


WRITES: Final = (
    (Object.TARGET_POSITION, "i", (-400_000, 0, 5_000, 100_000)),
    (Object.TARGET_VELOCITY, "i", (-500_000, 0, 90_000, 1_200_000)),
    (Object.TARGET_TORQUE, "h", (-500, -40, 0, 40, 300)),
    (Object.PROFILE_VELOCITY, "I", (100_000, 900_000)),
    (Object.PROFILE_ACCELERATION, "I", (200_000, 6_000_000)),
    (Object.PROFILE_DECELERATION, "I", (200_000, 6_000_000)),
    (Object.QUICK_STOP_OPTION, "h", (0, 1, 2, 3, 5, 6, 7)),
    (Object.HALT_OPTION, "h", (1, 2, 3)),
    (Object.SHUTDOWN_OPTION, "h", (0, 1)),
    (Object.DISABLE_OPERATION_OPTION, "h", (0, 1)),
    (Object.FAULT_REACTION_OPTION, "h", (0, 1, 2)),
    (Object.MAX_TORQUE, "H", (300, 3000)),
    (Object.FOLLOWING_ERROR_WINDOW, "I", (2_000, 0xFFFF_FFFF)),
    (Object.POLARITY, "B", (0, 0x40, 0x80)),
    (Object.HOMING_METHOD, "b", (1, 7, 17, 33, 35, 37)),
)
"""Object, its type, and what is written to it."""


@pytest.mark.parametrize("seed", few_of(range(6), 3))
def test_what_a_drive_does_is_told(seed: int) -> None:
    random = Random(seed)
    bench = ServoBench(DriveParameters(), seed)
    lines = []
    for _ in range(260):
        done = _do(bench, random)
        frames, bench.sent = bench.sent, []
        heard = crc32(b"".join(frame.can_id.to_bytes(4, "big") + frame.data for frame in frames))
        firmware = bench.servo.drive.firmware
        lines.append(
            f"{done}: {bench.statusword:04X}h, {len(frames)} frames {heard:08X}h, "
            f"{firmware.speed_rad_s:.6g} rad/s, {firmware.torque_demand_nm:.5g} N m"
        )
    hold("\n".join(lines), TOLD / f"a_drive_{seed}.txt")


def _do(bench: ServoBench, random: Random) -> str:
    """One thing that a master may do, and a few milliseconds with SYNCs and its heartbeat."""
    what = random.choice(
        ("write", "write", "mode", "enable", "enable", "word", "word", "word", "wait", "reset")
    )
    if what == "write":
        index, code, values = random.choice(WRITES)
        value = random.choice(values)
        what = f"write {index:04X}h = {value}: {bench.write(index, code, value)}"
    elif what == "mode":
        mode = random.choice(tuple(Mode))
        what = f"mode {mode}: {bench.write(Object.MODES_OF_OPERATION, 'b', mode)}"
    elif what == "enable":
        bench.command(*ENABLE)
    elif what == "word":
        torque = random.choice((0, 0, -300, 900))
        word = random.choice((0x0F, 0x1F, 0x3F, 0x7F, 0x10F, 0x5F, 0x1F, 0x0F, 0x02, 0x06, 0x07, 0x00))
        bench.rpdo(word, torque)
        what = f"word {word:04X}h, torque {torque}"
    elif what == "reset":
        bench.rpdo(CONTROLWORDS[DriveCommand.FAULT_RESET])
        bench.rpdo(0)
    for _ in range(random.choice((1, 5, 40, 100))):
        bench.sync()
        bench.receive(Frame(0x77F, b"\x05"))
        bench.wait_ms(1)
    return what
