"""What a drive of another process tells for the recording alone."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.configuration.config_files import toml_text
from tests.rrd_columns import numbers
from tests.scenario.processes import BENCH, hub_name, simulated_drive
from tests.unit.hil.test_observed_objects import EXAMPLES, told


@pytest.fixture(scope="module")
def unviewed_recordings() -> None:
    """None: run.rrd is read."""


@pytest.mark.xdist_group("real time")
def test_on_the_hub_a_drive_of_another_process_tells_them(tmp_path: Path) -> None:
    bus = hub_name("observed")
    tables = tomllib.loads(BENCH.read_text())
    tables["drive"]["axis1"] |= {"motor": str(EXAMPLES / "motors" / "ling2012.toml"), "observe": ["6079"]}
    tables["bench"]["duration_s"] = 1.0
    tables["load"] = tables["verdict"] = {}
    path = tmp_path / "bench.toml"
    path.write_text(toml_text(tables))
    with simulated_drive(bus):
        done = CliRunner().invoke(app, ["run", str(path), "--bus", bus, "--record", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    _, values = told(tmp_path / "run", 0x481, "<I")
    assert len(values) >= 90
    _, volts = numbers(tmp_path / "run" / "run.rrd", "/axis1/observed/6079h_0")
    np.testing.assert_allclose(volts, 300.0)
