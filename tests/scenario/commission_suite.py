"""``hil commission`` of an unknown drive in another process, on whatever bus in real time."""

import json
import signal
import subprocess
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.scenario.processes import in_background, serving
from tests.warm.start import hil

SEED = 3
"""Polarity, position and velocity are told wrong."""
COMMISSION_LIMIT_S = 170


@contextmanager
def unknown_drive(bus: str, folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """``hil rehearse`` on ``bus``, ready when entered; nameplate and truth are in ``folder``."""
    command = ["rehearse", "--bus", bus, "--node", "1", "--seed", str(SEED)]
    command += ["--nameplate", str(folder / "plate.toml"), "--truth", str(folder / "truth.toml"), *options]
    with serving(command) as process:
        yield process


class CommissionSuite:
    """The same on every bus; how near the figures come in real time is the machine's, not the bus's."""

    ended_at = ""
    """Title of the step at whose beginning the operator ends it; empty: it goes through all."""

    @pytest.fixture
    def bus_spec(self) -> str:
        """Overridden."""
        raise NotImplementedError

    @pytest.fixture
    def drive_spec(self, bus_spec: str) -> str:
        """How the drive's process names the bus."""
        return bus_spec

    def test_an_unknown_drive_is_commissioned_and_put_back(
        self, drive_spec: str, bus_spec: str, tmp_path: Path
    ) -> None:
        out = tmp_path / "out"
        command = [
            *hil(), "commission", "--bus", bus_spec, "--node", "1", "--out", str(out),
            "--motor", str(tmp_path / "plate.toml"), "--yes", "--json",
            "--period-us", "10000", "--heartbeat-timeout-ms", "1500",
        ]  # fmt: skip
        with unknown_drive(drive_spec, tmp_path):
            process = in_background(command, stdin=subprocess.DEVNULL)
            assert process.stderr is not None
            said = ""
            for line in process.stderr:
                said += line
                if self.ended_at and line.endswith(f" {self.ended_at}\n"):
                    process.send_signal(signal.SIGINT)
            told, _ = process.communicate(timeout=COMMISSION_LIMIT_S)
        assert process.returncode == (130 if self.ended_at else 0), said
        figures = json.loads(told)
        steps = {step["name"]: step for step in figures["steps"]}
        assert figures["restored"] is True, said
        truth = tomllib.loads((tmp_path / "truth.toml").read_text())
        faults = " ".join(fault for step in figures["steps"] for fault in step["faults"])
        for name in truth["units"]["faults"]:
            assert name in faults, said
        turn = steps["turn"]["figures"]
        assert turn["position_rad"] == pytest.approx(truth["units"]["position_rad"], rel=1e-3)
        assert turn["velocity_rad_s"] == pytest.approx(truth["units"]["velocity_rad_s"], rel=1e-3)
        watch = steps["watchdog"]["figures"]
        assert watch["timeout_ms"] == 1500
        assert 1400 < watch["reaction_ms"] < 2300
        assert (out / "drive.dcf").exists()
        if self.ended_at:
            return
        mechanics = steps["mechanics"]["figures"]
        assert mechanics, steps["mechanics"]
        assert mechanics["inertia_kg_m2"] == pytest.approx(truth["motor"]["inertia_kg_m2"], rel=0.1)
        assert (out / "plots" / "mechanics.png").stat().st_size > 10_000
