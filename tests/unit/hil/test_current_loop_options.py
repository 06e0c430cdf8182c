"""Where the current loop of a speed design is taken from."""

from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.drive_current_loop import KnownLoop
from servobench.hil.terminal.current_loop_options import CurrentLoopOptions

EXAMPLES = Path(__file__).parents[3] / "examples"


def current_loop(
    bench: Path | None, axis: str | None, commissioned: Path | None, bandwidth_hz: float | None
) -> KnownLoop:
    options = CurrentLoopOptions(
        bench=bench, axis=axis, commissioned=commissioned, current_bandwidth_hz=bandwidth_hz
    )
    return options.known_loop()


def test_without_anything_said_it_is_the_simulated_drives() -> None:
    loop = current_loop(None, None, None, None)
    assert (loop.order, loop.bandwidth_hz) == (1, 800.0)


def test_a_bench_says_it_by_its_own_key() -> None:
    loop = current_loop(EXAMPLES / "ling2012_cases" / "case1-stamp.toml", None, None, None)
    assert loop.bandwidth_hz == pytest.approx(53.8318)
    assert loop.key == "drive.axis1.simulation.current_bandwidth_hz"
    third = current_loop(EXAMPLES / "three_axes.toml", "axis3", None, None)
    assert third.key == "drive.axis3.simulation.inner_rate_hz"


def test_one_of_several_axes_must_be_named() -> None:
    with pytest.raises(BadInput, match="one of axis1, axis2, axis3"):
        current_loop(EXAMPLES / "three_axes.toml", None, None, None)
    with pytest.raises(BadInput, match="'axis9', expected one of axis1"):
        current_loop(EXAMPLES / "three_axes.toml", "axis9", None, None)


def test_a_speed_design_knows_no_h_infinity_loop() -> None:
    with pytest.raises(BadInput, match=r"axis1\.current_control\.controller: found 'a loop of order 4'"):
        current_loop(EXAMPLES / "azaiz2007_hinf.toml", None, None, None)


def test_two_sources_contradict_each_other() -> None:
    with pytest.raises(BadInput, match="either --bench or --current-bandwidth-hz"):
        current_loop(EXAMPLES / "ling2012.toml", None, None, 54.0)
    with pytest.raises(BadInput, match="--bench with it"):
        current_loop(None, "axis1", None, None)


def drive_file(folder: Path, text: str) -> Path:
    path = folder / "drive.toml"
    path.write_text(f"[drive]\nnode = 1\nvendor = 0\nproduct = 0\n{text}")
    return path


def test_a_commissioned_drive_has_been_measured(tmp_path: Path) -> None:
    measured = drive_file(tmp_path, "[current_loop]\norder = 1\nbandwidth_hz = 634.4\n")
    assert current_loop(None, None, measured, None).bandwidth_hz == 634.4
    with pytest.raises(BadInput, match=r"current_loop: missing.*hil commission"):
        current_loop(None, None, drive_file(tmp_path, ""), None)


def test_a_bench_on_a_real_bus_goes_by_the_measurement(tmp_path: Path) -> None:
    measured = drive_file(tmp_path, "[current_loop]\nbandwidth_hz = 634.4\n")
    bench = tmp_path / "bench.toml"
    text = (EXAMPLES / "any_bus.toml").read_text()
    text = text.replace('"motors/', f'"{EXAMPLES}/motors/')
    bench.write_text(text.replace('spec = "simulated"', 'spec = "hub:somewhere"'))
    with pytest.raises(BadInput, match=r"drive\.axis1\.commissioned\.current_loop: missing"):
        current_loop(bench, None, None, None)
    bench.write_text(bench.read_text().replace("node = 1\n", f'node = 1\ncommissioned = "{measured}"\n', 1))
    assert current_loop(bench, None, None, None).bandwidth_hz == 634.4
