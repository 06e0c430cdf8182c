"""How much the torque swings about its mean while nothing asks for it, and whether that is noise.

What is looked at is the commanded torque, which every cycle has, of the cycles whose reference and load have
not changed for the settling time, in blocks:

    reference  ____/~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
    load       _____________________________/~~~~~~~~~~~~~
    blocks         |settling|   |   |   |...|settling|   |

A block's figure is the rms about the block's own mean, so a load that is slowly taken up is no swing. A noisy
speed makes the torque noisy too, however good the loop is: its power is spread over the frequencies that the
loop lets through. A limit cycle goes on in step for ever, and has its power in one line.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_S
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.reviewing.envelope import Largest
from servobench.hil.rows.recording_plan import AxisPlan
from servobench.hil.rows.records import Rows

BLOCK: Final = 128
"""Cycles of which the rms is taken."""
WINDOW: Final = 4 * BLOCK
"""Cycles of which the spectrum is taken, those of a block and before it."""
PERIODS_MIN: Final = 16
"""In a window, of a line that can be told from noise: at 1 kHz from 31 Hz up, at 500 Hz from 16 Hz."""
LINE_SHARE: Final = 0.75
"""Share of a window's power in its strongest line and the two beside it. A sine has 1. The noise of a loop
with a damping of 0.2 had 0.72 at most in 4000 windows, of a line with 16 periods or more; white noise has
0.1."""
SWING_SHARE: Final = 0.05
"""Smallest swing, as a share of the rated torque, rms: below it a limit cycle of one step of the speed's or
the torque's resolution is no harm, and any coarse encoder makes one."""
NOISE_SHARE_MAX: Final = 0.25
"""Largest noise, as a share of the rated torque: more is no noise, whatever its spectrum; a limit cycle whose
periods lost readings break has no line."""


class Swing(NamedTuple):
    """A torque that swings as no noise makes it."""

    at: int
    """When the last cycle looked at was due, ns."""
    rms_nm: float
    frequency_hz: float
    share: float
    """Share of its power in one line."""

    def describe(self) -> str:
        """In words, for the events of a run."""
        return (
            f"the torque swings by {self.rms_nm:.3g} N m rms about its mean while speed and load stay, "
            f"{100.0 * self.share:.0f} % of it at {self.frequency_hz:.3g} Hz: a limit cycle, unless the load "
            "swings so"
        )


class TorqueSwingMeter:
    """Streaming; any division of the rows into chunks gives the same figures, bit by bit."""

    def __init__(self, axis: AxisPlan, settling_ns: int) -> None:
        rated_nm = math.inf if axis.rated_torque_nm is None else axis.rated_torque_nm
        self._swing_nm, self._noise_max_nm = SWING_SHARE * rated_nm, NOISE_SHARE_MAX * rated_nm
        self._settling_ns = settling_ns
        self._last_asked: tuple[float, float] | None = None
        self._changed_at = 0
        self._torque = np.empty(0)
        self._due_at = np.empty(0, np.int64)
        self._judged = 0
        self._told = False
        self.worst = Largest()
        """Rms of the blocks so far, N m, and when the last cycle of that block was due, ns."""
        self._swings: list[Swing] = []

    def add(self, rows: Rows) -> None:
        """Take in rows of this axis: (n,) of ROW_DTYPE, in order of sequence."""
        commanded = rows["command_expires_at"] != NOTHING
        if not commanded.all():
            rows = rows.compress(commanded)
        if not rows.size:
            return
        steady = self._steady(rows)
        edges = np.flatnonzero(np.diff(steady)) + 1
        for part, is_steady in zip(np.split(rows, edges), steady[np.concatenate(([0], edges))], strict=True):
            if is_steady:
                self._take(part)
            else:
                self._torque, self._due_at = self._torque[:0], self._due_at[:0]
                self._judged, self._told = 0, False

    def take_swings(self) -> list[Swing]:
        """Those found since the last call: the first of each time between two changes."""
        swings, self._swings = self._swings, []
        return swings

    def _steady(self, rows: Rows) -> NDArray[np.bool_]:
        reference, load, due_at = rows["reference_rad_s"], rows["load_torque_nm"], rows["due_at"]
        if self._last_asked is None:
            self._last_asked, self._changed_at = (float(reference[0]), float(load[0])), int(due_at[0])
        changed = (np.diff(reference, prepend=self._last_asked[0]) != 0.0) | (
            np.diff(load, prepend=self._last_asked[1]) != 0.0
        )
        changed_at = np.maximum.accumulate(np.where(changed, due_at, self._changed_at))
        self._last_asked, self._changed_at = (float(reference[-1]), float(load[-1])), int(changed_at[-1])
        steady: NDArray[np.bool_] = due_at - changed_at >= self._settling_ns
        return steady

    def _take(self, rows: Rows) -> None:
        torque = np.concatenate((self._torque, rows["command_torque_nm"]))
        due_at = np.concatenate((self._due_at, rows["due_at"]))
        ends = range(self._judged + BLOCK, torque.size + 1, BLOCK)
        for end in ends:
            first = max(0, end - WINDOW)
            self._judge(torque[first:end], due_at[first:end])
        self._judged += BLOCK * len(ends)
        spare = max(0, self._judged - WINDOW)
        self._torque, self._due_at, self._judged = torque[spare:], due_at[spare:], self._judged - spare

    def _judge(self, torque: NDArray[np.float64], due_at: NDArray[np.int64]) -> None:
        """Take in the block at the end of a window, which is shorter soon after a change."""
        rms_nm = float(np.std(torque[-BLOCK:]))
        self.worst.note(int(due_at[-1]), rms_nm)
        if self._told or rms_nm < self._swing_nm:
            return
        line, share = strongest_line(torque)
        in_step = torque.size == WINDOW and line >= PERIODS_MIN and share >= LINE_SHARE
        if in_step or rms_nm >= self._noise_max_nm:
            self._told = True
            time_s = (due_at[-1] - due_at[0]) / NS_PER_S * torque.size / (torque.size - 1)
            self._swings.append(Swing(int(due_at[-1]), rms_nm, float(line / time_s), share))


def strongest_line(signal: NDArray[np.float64]) -> tuple[int, float]:
    """Number of the strongest line, and its share of the power with the two beside it.

    ``signal``: (n,); Hann's window spreads a sine of any frequency over three lines.
    """
    windowed = (signal - signal.mean()) * np.hanning(signal.size + 1)[:-1]
    power = np.abs(np.fft.rfft(windowed)) ** 2
    power[1:-1] *= 2.0
    total = float(power.sum())
    if total == 0.0:
        return 0, 0.0
    line = int(np.argmax(power))
    return line, float(power[max(0, line - 1) : line + 2].sum()) / total
