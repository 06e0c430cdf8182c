"""A third party on the hub: it writes down every frame of the others, and reads the drive by an SDO client of
its own (CiA 301 7.2.4) while none of the commands runs."""

import configparser
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Self

import can

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.witness.frames import Frame

Key = tuple[int, int]
_ANSWER_S: Final = 60.0
"""A simulated drive of a busy machine may be kept waiting for seconds."""
_SECTION: Final = re.compile(r"([0-9A-Fa-f]{4})(?:sub([0-9A-Fa-f]{1,2}))?")
_DOMAIN: Final = 0xF


class NoAnswerFromDrive(Exception):
    """The drive did not answer the witness."""


class Described:
    """A variable as the sheet's own text has it."""

    def __init__(self, options: configparser.SectionProxy) -> None:
        self.access = options.get("AccessType", "rw").strip().lower()
        self.data_type = int(options.get("DataType", "0").strip() or "0", 0)

    @property
    def readable(self) -> bool:
        """It can be read, and within a moment."""
        return self.access != "wo" and self.data_type != _DOMAIN

    @property
    def writable(self) -> bool:
        return self.access in ("rw", "wo", "rww", "rwr")


def described(sheet: Path) -> dict[Key, Described]:
    """Variables of an EDS or DCF, by its text, as far as a plain reader of sections gets (CiA 306-1 4.6)."""
    sections = configparser.RawConfigParser(strict=False, allow_no_value=True, comment_prefixes=(";", "#"))
    sections.optionxform = str  # type: ignore[method-assign,assignment]
    text = sheet.read_bytes().decode("latin-1")
    sections.read_string(text[text.index("[") :])
    variables = {}
    parents = {name[:4].upper() for name in sections if _SECTION.fullmatch(name) and len(name) > 4}
    for name in sections:
        match = _SECTION.fullmatch(name)
        if match is not None and (match[2] or name.upper() not in parents):
            variables[int(match[1], 16), int(match[2] or "0", 16)] = Described(sections[name])
    return variables


class Witness:
    """On the hub from its beginning to its end."""

    def __init__(self, hub: str, node: int) -> None:
        self._bus = can.Bus(interface="hub", channel=hub)
        self._node = node
        self._clock = MonotonicClock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()

    # ---- listening ------------------------------------------------------------------------------------

    def frames_while(self, going: "Iterator[bool]") -> Iterator[Frame]:
        """Frames of the others for as long as ``going`` yields True, which is asked every 50 ms, and those
        that were on the bus by then and have not been fetched yet."""
        for goes in going:
            asked = self._clock.now()
            fetched = False
            while self._clock.now() - asked < NS_PER_S // 20 or not (goes or fetched):
                message = self._bus.recv(0.05)
                fetched = message is None or message.timestamp * NS_PER_S > asked
                if message is not None and not message.is_error_frame and not message.is_remote_frame:
                    yield Frame(message.timestamp, message.arbitration_id, bytes(message.data))
            if not goes:
                return

    # ---- asking ---------------------------------------------------------------------------------------

    def readings(self, variables: dict[Key, Described]) -> dict[Key, bytes]:
        """Every variable that can be read; what the drive refuses is left out."""
        held = {}
        for key, variable in sorted(variables.items()):
            if variable.readable and (value := self.read(*key)) is not None:
                held[key] = value
        return held

    def reset(self) -> None:
        """Reset the node, and wait until it has booted (CiA 301 7.2.8.2.1.2 and 7.2.8.3.3)."""
        self._bus.send(can.Message(arbitration_id=0, data=[0x81, self._node], is_extended_id=False))
        give_up = self._clock.now() + _ANSWER_S * NS_PER_S
        while self._clock.now() < give_up:
            message = self._bus.recv(1.0)
            if message is not None and message.arbitration_id == 0x700 + self._node and message.data[0] == 0:
                return
        raise NoAnswerFromDrive

    def read(self, index: int, sub: int) -> bytes | None:
        """Upload, expedited or in segments; None if the drive refuses."""
        answer = self._ask(bytes([0x40, index & 0xFF, index >> 8, sub, 0, 0, 0, 0]))
        if answer[0] == 0x80:
            return None
        if answer[0] & 0x02:
            return answer[4 : 8 - (answer[0] >> 2 & 3)] if answer[0] & 0x01 else answer[4:8]
        data, toggle = b"", 0
        while True:
            segment = self._ask(bytes([0x60 | toggle, 0, 0, 0, 0, 0, 0, 0]))
            if segment[0] == 0x80:
                return None
            data += segment[1 : 8 - (segment[0] >> 1 & 7)]
            toggle ^= 0x10
            if segment[0] & 0x01:
                return data

    def _ask(self, request: bytes) -> bytes:
        self._bus.send(
            can.Message(arbitration_id=0x600 + self._node, data=request, is_extended_id=False), 1.0
        )
        until = self._clock.now() + round(_ANSWER_S * NS_PER_S)
        while self._clock.now() < until:
            message = self._bus.recv(0.1)
            if message is not None and message.arbitration_id == 0x580 + self._node:
                return bytes(message.data)
        raise NoAnswerFromDrive(f"node {self._node} did not answer {request.hex()}")


@contextmanager
def on_hub(hub: str, node: int) -> Iterator[Witness]:
    """A witness there."""
    with Witness(hub, node) as witness:
        yield witness
