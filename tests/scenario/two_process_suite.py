"""One bench file with the drive in a process of its own, on whichever bus in real time."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from servobench.hil.pytest_plugin import StartDrive
from tests.scenario.processes import changed_bench, run

CYCLES = 300
"""3 s at 100 Hz."""


class TwoProcesses:
    """``hil run`` and ``hil simulate``; a subclass says on which bus by the marker ``servo_bus``."""

    limits: ClassVar[Mapping[str, float]] = {}
    """Of ``[verdict]``, in place of the bench file's."""

    def test_the_bench_file_passes_and_is_recorded(
        self, servo_bus: str, servo_process: StartDrive, tmp_path: Path
    ) -> None:
        drive = servo_process(1)
        status, summary, messages = run(changed_bench(tmp_path, **self.limits), servo_bus, tmp_path / "run")

        assert status == 0, messages
        assert drive.stop() == 0
        assert summary["verdict"]["passed"] is True
        assert summary["cycles"] > 0.9 * CYCLES
        assert summary["reading_delay_us"]["p50"] > 0
        names = {path.name for path in (tmp_path / "run").iterdir()}
        assert {"run.rrd", "frames.arrow", "bench.toml", "summary.json"} <= names
        assert (tmp_path / "run" / "frames.arrow").stat().st_size > 0
