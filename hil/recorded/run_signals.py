"""The signals of a recorded run as envelopes: an hour in bounded memory."""

from dataclasses import dataclass, field

from drivers.rotation import RPM_PER_RAD_S
from hil.recorded.recorded_run import RecordedRun
from hil.recording.lanes import error_limit_rpm
from hil.recording.row_series import main_lines_of
from hil.reviewing.envelope import Envelope
from hil.reviewing.histogram import TimeHistogram
from hil.reviewing.review import Review
from hil.rows.records import Rows

_COUNTED_SHARE = 0.98
"""As in the pages: a fault of a few cycles does not flatten the rest."""


@dataclass
class RunSignals:
    """Of one run; :meth:`add` all of its rows, then :meth:`judge`."""

    axes: tuple[str, ...]
    deadline_ns: int
    signals: dict[str, Envelope] = field(default_factory=dict)
    """By axis and series, as "axis1/speed/measured"; r/min, N m and us over ns of the run time."""
    delays: dict[str, TimeHistogram] = field(default_factory=dict)
    error_limits_rpm: dict[str, float | None] = field(default_factory=dict)
    counted_error_rpm: dict[str, float] = field(default_factory=dict)
    """How large nearly all of the error is that counts, by axis."""

    def add(self, rows: Rows, first_cycle: int = 0) -> None:
        """Take in rows; ``first_cycle``: what their instants count it as."""
        for number, name in enumerate(self.axes):
            mine = rows if len(self.axes) == 1 else rows[rows["axis"] == number]
            for path, times, values in main_lines_of(mine, 1.0):
                self.signals.setdefault(f"{name}/{path}", Envelope()).add(times - first_cycle, values)

    def judge(self, review: Review, run: RecordedRun) -> None:
        """What the signals are held against, by the review of the same rows."""
        for name, meter, delay in zip(self.axes, review.errors, review.delays, strict=True):
            self.error_limits_rpm[name] = error_limit_rpm(meter, run.review.limits)
            self.counted_error_rpm[name] = (meter.counted.largest(_COUNTED_SHARE) or 0.0) * RPM_PER_RAD_S
            self.delays[name] = delay


def signals_of(run: RecordedRun) -> RunSignals:
    """Read the rows once."""
    signals, review = RunSignals(run.axes, run.config.loop.deadline), Review(run.review)
    for rows in run.rows():
        signals.add(rows)
        review.add(rows)
    signals.judge(review, run)
    return signals
