"""Signals that drives report for the recording alone, from the frames of their TPDOs.

In which TPDO of a drive an object travels is read off the answers that it gave as its mapping was read back.
"""

from collections.abc import Iterator, Mapping
from struct import calcsize
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import SDO_ANSWER
from servobench.drivers.canopen.pdo import PdoDirection
from servobench.drivers.cia402.drive_setup import NUMBERS
from servobench.hil.rows.recording_plan import ObservedDrive, ObservedSignal

Signal = tuple[str, NDArray[np.int64], NDArray[np.float64]]
"""Path, instants and values, (n,)."""
_FOUR_BYTES: Final = 0x43
"""Answer to an upload, expedited, with four bytes (CiA 301 7.2.4.3.6)."""


class ObservedFrames:
    """Observed frames of all drives of a run."""

    def __init__(self, observed: Mapping[str, ObservedDrive]) -> None:
        self._drives = [_Drive(f"/{axis}/", drive) for axis, drive in observed.items()]
        self._held: dict[str, list[tuple[NDArray[np.int64], NDArray[np.float64]]]] = {}

    def take(self, frames: NDArray[np.void]) -> None:
        """``frames``: (n,) of FRAME_DTYPE."""
        for drive in self._drives if frames.size else ():
            for path, times, values in drive.told(frames.compress(frames["sent"] >> 1 == drive.segment)):
                self._held.setdefault(path, []).append((times, values))

    def drain(self) -> Iterator[Signal]:
        """Yield the signals taken since the last call."""
        held, self._held = self._held, {}
        for path, parts in held.items():
            times, values = zip(*parts, strict=True)
            yield path, np.concatenate(times), np.concatenate(values)


class _Drive:
    def __init__(self, root: str, drive: ObservedDrive) -> None:
        self.segment = drive.segment
        self._root, self._node = root, drive.node
        self._signals = {each.object: each for each in drive.signals}
        self._every_ns = drive.every_ns
        self._last_at: dict[str, int] = {}
        """Of each signal the instant of the frame that told it last."""
        self._words: dict[int, dict[int, int]] = {}
        """By the number of a TPDO, its mapping words by their sub-index."""

    def told(self, frames: NDArray[np.void]) -> Iterator[Signal]:
        ids = frames["can_id"]
        for answer in frames[ids == SDO_ANSWER + self._node]["data"]:
            self._learn(answer)
        for number, words in self._words.items():
            told = frames[ids == PdoDirection.TRANSMIT.default_cob_id(number, self._node)]
            for signal, first in self._places(words) if told.size else ():
                size = calcsize(signal.code)
                whole = told.compress(told["length"] >= first + size)
                raw = np.ascontiguousarray(whole["data"][:, first : first + size])
                values = raw.view(np.dtype(signal.code).newbyteorder("<"))[:, 0]
                yield self._interrupted(
                    self._root + signal.path, whole["at"], signal.factor * values.astype(float)
                )

    def _interrupted(self, path: str, times: NDArray[np.int64], values: NDArray[np.float64]) -> Signal:
        """Put no number where a frame did not come: no line crosses a gap."""
        if not times.size or not self._every_ns:
            return path, times, values
        before = np.append(self._last_at.get(path, times[0]), times[:-1])
        self._last_at[path] = int(times[-1])
        gaps = np.flatnonzero(2 * (times - before) > 3 * self._every_ns)
        missed = times[gaps] - self._every_ns
        return path, np.insert(times, gaps, missed), np.insert(values, gaps, np.nan)

    def _learn(self, answer: NDArray[np.uint8]) -> None:
        number = int.from_bytes(answer[1:3].tobytes(), "little") - PdoDirection.TRANSMIT.mapping_base + 1
        if answer[0] == _FOUR_BYTES and answer[3] and number in NUMBERS:
            word = int.from_bytes(answer[4:8].tobytes(), "little")
            self._words.setdefault(number, {})[int(answer[3])] = word

    def _places(self, words: Mapping[int, int]) -> Iterator[tuple[ObservedSignal, int]]:
        """Each signal with its first byte."""
        bits = 0
        for _, word in sorted(words.items()):
            signal = self._signals.get((word >> 16, word >> 8 & 0xFF))
            if signal is not None:
                yield signal, bits // 8
            bits += word & 0xFF
