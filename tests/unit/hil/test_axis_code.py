"""Code of one's own goes into the recording, and the bench that is kept there names the copy."""

import shutil
import tomllib
from hashlib import blake2b
from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution.assembly import axis_code
from servobench.hil.execution.recorded_bench import keep_files, recording_plan

FIRST = Path(__file__).parents[3] / "examples" / "first"


def test_the_copy_is_the_file_and_the_kept_bench_names_it(tmp_path: Path) -> None:
    config = load_bench(FIRST / "bench.toml")
    (axis,) = config.axes
    code = axis_code(config, {}, real_time=False)
    source = (FIRST / "controller.py").read_bytes()
    (kept,) = code[axis].own.values()
    assert kept.digest == blake2b(source, digest_size=16).hexdigest()
    keep_files(config, code, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [f"{axis}-controller.py"]
    assert (tmp_path / f"{axis}-controller.py").read_bytes() == source
    kept_bench = recording_plan(config, tmp_path, code, {}, real_time=False).bench_toml
    controller = tomllib.loads(kept_bench)["drive"][axis]["controller"]
    assert controller["object"] == f"{axis}-controller.py:SpeedController"


def test_a_controller_that_is_given_needs_no_file(tmp_path: Path) -> None:
    config = load_bench(FIRST / "bench.toml")
    (axis,) = config.axes
    given = axis_code(config, {}, real_time=False)[axis].controller
    code = axis_code(config, {axis: given}, real_time=False)
    assert code[axis].controller is given
    assert code[axis].own == {}
    keep_files(config, code, tmp_path)
    assert list(tmp_path.iterdir()) == []
    plan = recording_plan(config, tmp_path, code, {}, real_time=False)
    assert plan.bench_toml == config.resolved_text()


def test_a_file_that_is_gone_is_named_with_its_key(tmp_path: Path) -> None:
    shutil.copytree(FIRST, tmp_path / "first")
    config = load_bench(tmp_path / "first" / "bench.toml")
    (tmp_path / "first" / "controller.py").unlink()
    (axis,) = config.axes
    with pytest.raises(BadInput) as caught:
        axis_code(config, {}, real_time=False)
    assert caught.value.key == f"drive.{axis}.controller.object"
