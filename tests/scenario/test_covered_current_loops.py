"""A controller made for a constant delay, and the drives that its file covers."""

from pathlib import Path

from typer.testing import CliRunner

from servobench.design.delay.delay_loop import speed_model
from servobench.design.delay.delay_norm import hinf_norm
from servobench.drivers.bounded_file import read_toml
from servobench.hil.cli import app
from servobench.hil.configuration.bench_file import bench_from, load_controller
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.execution.network_guard import Certificates

EXAMPLES = Path(__file__).parents[2] / "examples"
MOTOR = str(EXAMPLES / "motors" / "ling2012.toml")


def test_a_drive_within_the_range_of_the_file_runs_and_one_outside_is_refused(tmp_path: Path) -> None:
    """The gain in the file is that of all drives in the range."""
    out = tmp_path / "k.toml"
    asked = ("design", "speed", MOTOR, "--delay-ms", "20", "--feedback", "speed", "--out", str(out))
    assert CliRunner().invoke(app, asked).exit_code == 0
    made = load_controller(out)
    assert made.kind == "state_feedback"
    assert made.made_for is not None
    assert made.certificate is not None
    loop, gain = made.made_for.current_loop, made.certificate.gain
    assert loop is not None
    assert gain is not None
    assert loop.bandwidth_min_hz < 700.0
    assert loop.bandwidth_max_hz > 900.0
    for bandwidth_hz in (loop.bandwidth_min_hz, loop.bandwidth_max_hz):
        model = speed_model(LING2012.parameters, current_bandwidth_hz=bandwidth_hz)
        assert hinf_norm(model.loop(made.gain, 0.02)) <= gain
    for bandwidth_hz, faults in ((900.0, 0), (1.01 * loop.bandwidth_max_hz, 1)):
        tables = read_toml(EXAMPLES / "network_designed.toml", "bench file")
        drive = tables["drive"]["axis1"]
        drive |= {"motor": MOTOR, "controller": str(out)}
        drive["simulation"] = {"current_bandwidth_hz": bandwidth_hz}
        assert len(Certificates(bench_from(tables, "bench.toml", tmp_path)).faults({})) == faults
