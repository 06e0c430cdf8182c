"""What it takes to draw the page of a long run: ten minutes and an hour, one axis and three, at 1 kHz.

The rows are those of a minute in simulated time, again and again. Figures are the size of run.rrd, and
the seconds from starting the viewer to its picture, which has to be filled over its whole width.
"""

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from servobench.hil.loop.cycle_record import COLUMNS, NOTHING
from servobench.hil.recorded.recorded_run import RecordedRun, open_run
from servobench.hil.recorded.viewer import draw_page
from servobench.hil.recording.telemetry import Telemetry
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.records import Rows
from servobench.hil.rows.run_files import RERUN_FILE
from servobench.hil.rows.side_rows import BeginEvent, StateEvent
from servobench.hil.verdict.summary import summarise
from tests.pictures.made import run
from tests.pictures.pixels import Picture, complaints
from tests.unit.hil.recording_tools import RESTING, plan_for, whole_outcome

_MINUTE_S: Final = 60
_INSTANTS: Final = [column.name for column in COLUMNS if column.is_instant]


def main() -> None:
    """Print a table, and leave with 1 if a picture does not show the whole run."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.bench_pictures", description=__doc__)
    parser.add_argument("--out", type=Path, help="keep the pictures in this folder")
    out: Path | None = parser.parse_args().out
    wrong: list[str] = []
    print(f"{'':24} {'run.rrd [MB]':>13} {'picture [s]':>12}")
    for bench, axes in (("ling2012.toml", 1), ("three_axes.toml", 3)):
        with tempfile.TemporaryDirectory() as name:
            recorded = open_run(run(bench, {"bench.duration_s": float(_MINUTE_S)})(Path(name) / "minute"))
            for minutes in (10, 60):
                folder = Path(name) / f"{minutes}min-{axes}axes"
                _write(recorded, minutes, folder)
                clock = MonotonicClock()
                began = clock.now()
                png = draw_page(folder)
                seconds = (clock.now() - began) / NS_PER_S
                size = (folder / RERUN_FILE).stat().st_size / 1e6
                print(f"{minutes:3} min, {axes} axes {'':8} {size:13.0f} {seconds:12.1f}", flush=True)
                lines = ("error", "torque", "delay") if axes == 1 else ("speed", "torque", "error")
                wrong += [f"{folder.name}: {each}" for each in complaints(Picture.of_png(png), lines, {})]
                if out is not None:
                    (out / f"{folder.name}.png").write_bytes(png)
                (folder / RERUN_FILE).unlink()
    print("\n".join(wrong), end="\n" if wrong else "")
    raise SystemExit(bool(wrong))


def _write(recorded: RecordedRun, minutes: int, folder: Path) -> None:
    folder.mkdir()
    plan = replace(plan_for(folder), name=recorded.config.bench.name, review=recorded.review)
    review = Review(plan.review)
    telemetry = Telemetry(plan, folder.name, rr.FileSink(folder / RERUN_FILE))
    telemetry.take_events([BeginEvent(Instant(0)), StateEvent(Instant(0), "phase", "running")])
    for rows in _minutes(recorded, minutes):
        telemetry.take_rows(rows)
        review.add(rows)
    drives = tuple(replace(RESTING, name=axis) for axis in recorded.axes)
    cycles = minutes * _MINUTE_S * 1000
    outcome = replace(whole_outcome(cycles), drives=drives)
    telemetry.finish(summarise(review.figures(), outcome, plan.review.limits, "", 1), review)


def _minutes(recorded: RecordedRun, minutes: int) -> Iterator[Rows]:
    """In blocks, as a logger sends them."""
    blocks = list(recorded.rows())
    for minute in range(minutes):
        for block in blocks:
            rows = block.copy()
            for column in _INSTANTS:
                known = rows[column] != NOTHING
                rows[column] = np.where(known, rows[column] + minute * _MINUTE_S * NS_PER_S, rows[column])
            rows["sequence"] += minute * _MINUTE_S * NS_PER_S // NS_PER_MS
            yield rows


if __name__ == "__main__":
    main()
