"""Looks after the recording of a run while its loop runs: some twenty times a second, never in between."""

from collections.abc import Callable

from drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from hil.recording.logger_process import RecordingFailed
from hil.recording.recorder import Recorder

_POLL_NS = NS_PER_MS


class RecordingWatch:
    """Ends a run that is not recorded any more, or lets it go on if that was asked for."""

    def __init__(self, recorder: Recorder, goes_on: bool, say: Callable[[str, str], None]) -> None:
        """``goes_on``: a run goes on unrecorded. ``say``: takes a text for the reader and its level."""
        self._recorder = recorder
        self._goes_on = goes_on
        self._say = say
        self._told = False

    def confirm(self, pump: Callable[[Instant], object] | None) -> None:
        """All so far is in the files, or nothing may move. Raises RecordingFailed.

        ``pump``: serves the bus up to an instant of the monotonic clock; None in simulated time, which stands
        still meanwhile, so that no run depends on how fast its logger starts.
        """
        clock = MonotonicClock()
        serve = clock.sleep_until if pump is None else pump

        def wait() -> None:
            serve(Instant(clock.now() + _POLL_NS))

        self._recorder.confirm(wait)

    def phase(self) -> str:
        """What the loop is doing: "running", or "not recorded" if it goes on so. Raises RecordingFailed."""
        if not self._told and (trouble := self._recorder.trouble()):
            if not self._goes_on:
                raise RecordingFailed(trouble)
            self._told = True
            self._say(f"not recorded: {trouble}", "CRITICAL")
        return "not recorded" if self._told else "running"
