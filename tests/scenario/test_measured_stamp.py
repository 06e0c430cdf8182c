"""A run goes by the resolution of stamps that its network file has, unless its bench says one."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app

EXAMPLES = Path(__file__).parents[2] / "examples"
NETWORK = """[network]
period_us = 1000
losses_in_a_row_max = 0
delay_max_us = 1000
[network.clocks.{name}]
stamp_resolution_us = {resolution_us}
"""


def run(folder: Path, *more: object, told: str = "") -> tuple[int, Any, float | None]:
    """Exit status, what it printed, and the resolution that the bench was run with."""
    bench = folder / "bench.toml"
    bench.write_text(
        '[bench]\nname = "coarse"\nduration_s = 0.2\n[loop]\nperiod_us = 1000\n'
        f'[drive.axis1]\nnode = 5\nmotor = "{EXAMPLES}/motors/ling2012.toml"\n{told}\n'
        "[drive.axis1.limits]\nspeed_max_rpm = 3000\ntorque_max_nm = 4.0\n"
        '[drive.axis1.controller]\nkind = "pid"\nproportional_nm_s_rad = 0.02\nintegral_nm_rad = 0.2\n'
        '[[reference.axis1]]\nat_s = 0.0\nkind = "step"\nspeed_rpm = 100.0\n'
    )
    done = CliRunner().invoke(
        app, ["run", str(bench), "--json", "--record", str(folder / "run"), *map(str, more)]
    )
    whole = json.loads(done.stdout)
    if done.exit_code:
        return done.exit_code, whole, None
    drive = tomllib.loads((folder / "run" / "bench.toml").read_text())["drive"]["axis1"]
    return 0, whole, drive.get("stamp_resolution_us")


@pytest.mark.parametrize(
    ("name", "told", "resolution_us"),
    [
        ("node5", "", 400.0),
        ("axis1", "", 400.0),
        ("node6", "", None),
        ("node5", "stamp_resolution_us = 2.0", 2.0),
    ],
)
def test_the_resolution_of_the_network_file_counts_unless_the_bench_says_one(
    name: str, told: str, resolution_us: float | None, tmp_path: Path
) -> None:
    network = tmp_path / "network.toml"
    network.write_text(NETWORK.format(name=name, resolution_us=400.0))
    status, whole, run_with = run(tmp_path, "--network", network, told=told)
    assert (status, run_with) == (0, resolution_us)
    by_order = whole["timing"]["axes"]["axis1"]["by_order"]
    assert (by_order > 0) == (resolution_us == 400.0), "a stamp of 400 us says too little at 1 ms"


def test_a_resolution_that_no_bench_may_have_is_bad_input(tmp_path: Path) -> None:
    network = tmp_path / "network.toml"
    network.write_text(NETWORK.format(name="node5", resolution_us=5000.0))
    status, whole, _ = run(tmp_path, "--network", network)
    assert status == 2
    assert "network.clocks.node5.stamp_resolution_us" in whole["verdict"]["reason"]
