"""Looks after the recording of a run while its loop runs: some twenty times a second, never in between."""

from collections.abc import Callable

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from servobench.hil.machine.progress import Progress
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.recording.run_recorder import RunRecorder
from servobench.virtual_bus.timeline import SimulatedClock

_POLL_NS = NS_PER_MS


class RecordingWatch:
    """Ends a run that is not recorded any more, or lets it go on if that was asked for."""

    def __init__(
        self, recorder: RunRecorder, goes_on: bool, progress: Progress, say: Callable[[str, str], None]
    ) -> None:
        """``goes_on``: a run goes on unrecorded. ``say``: takes a text for the reader and its level."""
        self._recorder = recorder
        self._goes_on = goes_on
        self._progress = progress
        self._say = say
        self._phase = "running"

    def confirm(self, network: CanopenNetwork) -> None:
        """All so far is in the files, or nothing may move. Raises RecordingFailed.

        The bus is served meanwhile, but simulated time stands still, paced or not: no run depends on
        how fast its logger starts.
        """
        wall = MonotonicClock()
        simulated = isinstance(network.clock, SimulatedClock)
        serve = wall.sleep_until if simulated else network.pump

        def wait() -> None:
            serve(Instant(wall.now() + _POLL_NS))

        self._recorder.confirm(wait)

    def attend(self, elapsed_s: float) -> None:
        """So much of the loop is done, s. Raises RecordingFailed, which is told before the drives stop."""
        trouble = "" if self._phase != "running" else self._recorder.trouble()
        if trouble:
            self._phase = f"not recorded: {trouble}"
        self._progress(self._phase, elapsed_s)
        if trouble and not self._goes_on:
            raise RecordingFailed(trouble)
        if trouble:
            self._say(self._phase, "CRITICAL")
