"""CANopenNode's gateway (CiA 309-3) as a master over the simulated drive: its own C, command by command.

Its sources are not part of this project: CANOPENNODE names a folder with them, as of
https://github.com/CANopenNode/CANopenNode; without it the test is left out. All is in lock step.
"""

import ctypes
import os
import re
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from servobench.design.mechanism import Coupling, Mechanism
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from tests.motors import LING

SOURCES = Path(os.environ.get("CANOPENNODE", ""))
pytestmark = pytest.mark.skipif(
    not (SOURCES / "309/CO_gateway_ascii.c").is_file(), reason="CANOPENNODE names no sources of CANopenNode"
)
HALF = 0.5 * LING.inertia_kg_m2
TURN = 65_536
NEAR = TURN // 1000
FRAME = "typedef struct { uint32_t ident; uint8_t DLC; uint8_t data[8]; } CO_frame_t;"
OPTIONS = r"""
#define CO_CONFIG_SDO_CLI (CO_CONFIG_SDO_CLI_ENABLE | CO_CONFIG_SDO_CLI_SEGMENTED)
#define CO_CONFIG_FIFO \
 (CO_CONFIG_FIFO_ENABLE | CO_CONFIG_FIFO_ASCII_COMMANDS | CO_CONFIG_FIFO_ASCII_DATATYPES)
#define CO_CONFIG_GTW (CO_CONFIG_GTW_ASCII | CO_CONFIG_GTW_ASCII_SDO)
#define CO_CONFIG_GTWA_COMM_BUF_SIZE 2000
#define CO_CONFIG_GTW_BLOCK_DL_LOOP 1
"""


class GatewayFrame(ctypes.Structure):
    """CO_frame_t."""

    _fields_ = (("ident", ctypes.c_uint32), ("length", ctypes.c_uint8), ("data", ctypes.c_uint8 * 8))


def compiled(folder: Path) -> ctypes.CDLL:
    """The gateway with the driver of its example, whose frames are ours."""
    driver = (SOURCES / "example/CO_driver_target.h").read_text(encoding="utf-8")
    for name, part in (("Ident", "ident"), ("DLC", "DLC"), ("Data", "data")):
        access = f"#define CO_CANrxMsg_read{name}(msg) (((CO_frame_t*)(msg))->{part})"
        driver = re.sub(rf"#define CO_CANrxMsg_read{name}\(msg\).*", access, driver)
    driver = driver.replace("/* Access to received CAN frame */", FRAME)
    (folder / "CO_driver_target.h").write_text(driver, encoding="utf-8")
    (folder / "CO_driver_custom.h").write_text(OPTIONS, encoding="utf-8")
    parts = (
        "309/CO_gateway_ascii",
        "301/CO_SDOclient",
        "301/CO_fifo",
        "301/crc16-ccitt",
        "301/CO_ODinterface",
    )
    files = [SOURCES / f"{part}.c" for part in (*parts, "example/OD")]
    includes = [f"-I{each}" for each in (folder, SOURCES, SOURCES / "example")]
    library = folder / "gateway.so"
    bridge = Path(__file__).with_name("gateway.c")
    options = ("-shared", "-fPIC", "-O1", "-DCO_DRIVER_CUSTOM")
    subprocess.run(["cc", *options, *includes, bridge, *files, "-o", library], check=True)
    return ctypes.CDLL(str(library))


class Gateway:
    """Commands of CiA 309-3 to a drive with two encoders."""

    def __init__(self, folder: Path) -> None:
        self._core: Any = compiled(folder)
        self._core.gateway_answer.restype = ctypes.c_char_p
        assert self._core.gateway_begin() == 0
        shaft = Coupling(HALF, HALF, 2000.0, 0.3, second_encoder=True)
        self._servo = SimulatedServo(1, replace(LING, mechanism=Mechanism(shaft)))
        self._now = Instant(0)
        self._number = 0
        self._servo.start(self._now)

    def wait_ms(self, milliseconds: float) -> None:
        until = Instant(self._now + round(milliseconds * NS_PER_MS))
        while (due := self._servo.wake_at) is not None and due <= until:
            self._now = max(self._now, due)
            self._hear(self._servo.wake(self._now))
        self._now = until

    def say(self, command: str) -> str:
        """The gateway's answer, without its number."""
        self._number += 1
        self._core.gateway_command(f"[{self._number}] 1 {command}\n".encode())
        out = (GatewayFrame * 64)()
        for _ in range(1000):
            self._core.gateway_process(100)
            for frame in out[: self._core.gateway_take(out)]:
                asked = Frame(frame.ident, bytes(frame.data)[: frame.length])
                self._hear(self._servo.receive(asked, self._now))
            self.wait_ms(0.1)
            number, _, text = self._core.gateway_answer().decode().partition("] ")
            if text.endswith("\n"):
                assert number == f"[{self._number}"
                return str(text.strip())
        raise AssertionError(f"no answer to {command}")

    def put(self, index: int, kind: str, value: int, sub: int = 0) -> str:
        return self.say(f"w 0x{index:04X} {sub} {kind} {value}")

    def get(self, index: int, kind: str, sub: int = 0) -> int:
        return int(self.say(f"r 0x{index:04X} {sub} {kind}"), 0)

    def enable(self, mode: int) -> None:
        self.put(0x6060, "i8", mode)
        for controlword in (0x06, 0x07, 0x0F):
            assert self.put(0x6040, "u16", controlword) == "OK"
        self.wait_ms(20)

    def _hear(self, frames: Sequence[Frame]) -> None:
        for frame in frames:
            data = bytes(frame.data)
            self._core.gateway_frame(frame.can_id, len(data), data)


@pytest.fixture
def gateway(tmp_path: Path) -> Gateway:
    return Gateway(tmp_path)


def test_it_sets_reads_and_is_refused(gateway: Gateway) -> None:
    given = (
        (0x607B, "i32", TURN, 2),
        (0x60F2, "u16", 0xC2, 0),
        (0x6086, "i16", 3, 0),
        (0x60A4, "u32", 96_000, 1),
    )
    for index, kind, value, sub in (
        *given,
        (0x60A3, "u8", 1, 0),
        (0x60D0, "i16", 6, 2),
        (0x60E1, "u16", 900, 0),
    ):
        assert gateway.put(index, kind, value, sub) == "OK"
        assert gateway.get(index, kind, sub) == value
    assert [gateway.get(index, "u32", 1) for index in (0x60E6, 0x60EB, 0x60E8, 0x60ED)] == [TURN, 1, 1, 1]
    wrong = ((0x60F2, "u16", 0x100, 0), (0x6086, "i16", 2, 0), (0x60A3, "u8", 2, 0), (0x60D0, "i16", 3, 1))
    for index, kind, value, sub in wrong:
        assert gateway.put(index, kind, value, sub).startswith("ERROR:0x06090030")
    assert gateway.put(0x60E6, "u32", 1, 1).startswith("ERROR:0x06010002")
    assert "servobench" in gateway.say("r 0x1008 0 vs")


def test_it_moves_the_short_way_and_reads_a_probe(gateway: Gateway) -> None:
    settings = ((0x60F2, "u16", 0xC0), (0x6086, "i16", 3), (0x6081, "u32", 480_000), (0x6083, "u32", 4800))
    for index, kind, value in (*settings, (0x6084, "u32", 4800)):
        assert gateway.put(index, kind, value) == "OK"
    gateway.put(0x607B, "i32", TURN, 2)
    gateway.enable(1)
    gateway.put(0x60B8, "u16", 0x19)
    gateway.put(0x607A, "i32", 62_000)
    gateway.put(0x6040, "u16", 0x1F)
    gateway.wait_ms(1500)
    assert gateway.get(0x6041, "u16") & 0x400
    assert [gateway.get(0x6064, "i32"), gateway.get(0x60E4, "i32", 1)] == pytest.approx(
        [62_000, 62_000], abs=NEAR
    )
    assert gateway.get(0x6063, "i32") == pytest.approx(62_000 - TURN, abs=NEAR)
    gateway.put(0x2110, "u8", 1, 11)
    assert gateway.get(0x60B9, "u16") == 3
    assert gateway.get(0x60BA, "i32") == pytest.approx(62_000, abs=NEAR)
