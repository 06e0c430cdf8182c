"""The recording of a commissioning: every frame and every action, in the formats of a run's.

Frames are kept in memory while an attempt at a step goes on, and written when it is over: with the drive
disabled. A process that is killed loses the frames of the step that was under way.
"""

import json
from pathlib import Path
from typing import Final

import numpy as np

from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Duration, Instant
from servobench.drivers.wire.frame_port import EXTENDED_FLAG, REMOTE_FLAG
from servobench.hil.execution.world import World
from servobench.hil.recording.append_file import AppendFile
from servobench.hil.rows.events import event_json
from servobench.hil.rows.recording_plan import SIMULATED_EPOCH
from servobench.hil.rows.run_files import EVENTS_FILE, FRAMES_FILE
from servobench.hil.rows.side_rows import FRAME_DTYPE, StateEvent, TextEvent, frame_row

_TRACK: Final = "step"


class SessionLog:
    """frames.arrow, frames.index and events.jsonl of one commissioning."""

    def __init__(self, folder: Path, world: World, bus: str, title: str) -> None:
        """``bus``: the spec; its last part is the interface of the frames. Error: OSError."""
        from servobench.hil.recording.frame_files import FrameFiles  # pyarrow, which no loop needs

        folder.mkdir(parents=True, exist_ok=True)
        self.failed = ""
        """Why nothing more is recorded; empty while recording."""
        self._clock = world.clock
        self._zero = self._clock.now()
        offset = world.wall_offset
        self._offset = Duration(SIMULATED_EPOCH - self._zero) if offset is None else offset
        self._rows: list[bytes] = []
        self._events: list[TextEvent | StateEvent] = []
        self._frames = FrameFiles(folder, (bus.rpartition(":")[2],))
        self._told = AppendFile(folder / EVENTS_FILE)
        world.link.tap(self._take)
        world.tap_errors(self._take)
        stamp_us = (self._zero + self._offset) // NS_PER_US
        seconds, us = divmod(stamp_us, NS_PER_S // NS_PER_US)
        self.event("INFO", f"{title}; 0 ns is ({seconds}.{us:06}) of {FRAMES_FILE}")

    def _take(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        """Take a frame, as ``BusLink.tap`` requires."""
        flags = (EXTENDED_FLAG if extended else 0) | (REMOTE_FLAG if remote else 0)
        self._rows.append(frame_row(at, can_id | flags, int(direction == "tx"), data))

    def event(self, level: str, text: str, at: Instant | None = None) -> None:
        """Record an event. ``level``: "INFO", "WARN", "ERROR", "CRITICAL"; ``at``: default now."""
        self._events.append(TextEvent(self._clock.now() if at is None else at, level, text))

    def step(self, name: str) -> None:
        """Record the begin of a step."""
        self._events.append(StateEvent(self._clock.now(), _TRACK, name))

    def write(self) -> None:
        """Write the collected frames to disk. A full disk ends the recording, not the commissioning."""
        rows, self._rows = self._rows, []
        events, self._events = self._events, []
        if self.failed:
            return
        frames = np.frombuffer(b"".join(rows), FRAME_DTYPE)
        frames = frames[np.argsort(frames["at"], kind="stable")]
        lines = [json.dumps(event_json(event, self._zero)) + "\n" for event in events]
        try:
            self._frames.write(frames, self._offset)
            self._told.write("".join(lines).encode())
        except OSError as error:
            self.failed = str(error)

    def close(self) -> None:
        """Close the recording."""
        self.write()
        if not self.failed:
            try:
                self._frames.close()
                self._told.close()
            except OSError as error:
                self.failed = str(error)
