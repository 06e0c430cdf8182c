"""What ``hil measure`` prints and writes of a measurement, which is made up here."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner, Result

from servobench.design.confidence import Interval
from servobench.drivers.canopen.pdo import PdoDirection, PdoEntry, PdoMap
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.cli import app
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.configuration.network_file import DelayFigures, Network, load_network
from servobench.hil.measuring import measure, picture
from servobench.hil.measuring.figures import ClockFigures, Measured, MeasuredDrive, fault_plan_text
from servobench.hil.measuring.loss_model import Losses, LossModel, Parameters
from servobench.hil.measuring.stages import WAYS, stage
from servobench.hil.measuring.subject import MeasureRequest
from servobench.hil.terminal.measure_report import print_measured
from tests.told import ROOT

REQUEST = MeasureRequest("hub:x", (3, 4), 500, 1000, 1_000_000, enable=True, speed_max_rad_s=10.0)
WAKE = stage("wake_up", "wake-up lateness", np.arange(1_000, 101_000, 1_000), "the host's clock")
NOT_ECHOED = stage("sync_on_bus", "SYNC on the bus", [], "no echo")
SAMPLE = stage("sample", "sample", [5_500], "by the stamp")
BURSTS = LossModel(
    False,
    Parameters(0.01, 0.25, 1.0, 0.0),
    {"p_good_to_bad": Interval(0.005, 0.02), "p_bad_to_good": Interval(0.2, 0.3)},
)
EVEN = LossModel(True, Parameters(0.0, 1.0, 1.0, 0.1), {"probability": Interval(0.08, 0.12)})
RUNS = tuple(range(9, 0, -1))
SPEED = PdoMap(PdoDirection.TRANSMIT, 1, 0x183, (PdoEntry(0x606C, 0, "i"),))
COMMAND = PdoMap(PdoDirection.RECEIVE, 1, 0x203, (PdoEntry(0x6071, 0, "h"),))
CLOCK = ClockFigures(12.345, 0.678, 1234.56, 7.89, 0)


UNKNOWN = Losses(0, 0, (), None, None, "not measured")


def drive(
    node: int,
    readings: Losses,
    commands: Losses,
    clock: ClockFigures | None = None,
    uncertain: int = 0,
    notes: tuple[str, ...] = (),
) -> MeasuredDrive:
    return MeasuredDrive(
        node, f"servo [{node}]", SPEED, COMMAND, [SAMPLE],
        dict.fromkeys(WAYS, UNKNOWN) | {"reading": readings, "command_behind_bus": commands},
        uncertain, clock, notes,
    )  # fmt: skip


MEASURED = Measured(
    REQUEST, 500, 7, False, EchoBasis.BUS, [WAKE, NOT_ECHOED],
    [
        drive(3, Losses(400, 30, RUNS, Interval(0.05, 0.1), BURSTS), UNKNOWN, CLOCK, 2, ("[note] of 3",)),
        drive(
            4,
            Losses(500, 1, RUNS[1:], Interval(1e-5, 0.012), None, "not identifiable: 1 runs"),
            Losses(300, 30, (30,), Interval(0.08, 0.12), EVEN),
        ),
    ],
    None, {}, 0, [],
)  # fmt: skip


def printed(measured: Measured, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("COLUMNS", "200")
    print_measured(measured)
    return "\n".join(" ".join(line.split()) for line in capsys.readouterr().out.splitlines())


TOLD = """\
500 cycles of 1000 us on hub:x, drives enabled; 7 went without SYNC

Node 3: servo [3]
us p50 p99 p99.9 max within
wake-up lateness 50.0 99.0 100.0 100.0 97.049 % the host's clock
SYNC on the bus not measured: no echo
sample 5.5 5.5 5.5 5.5 5.000 % by the stamp
losses lost of % true % runs of 1, 2, ... model (maximum likelihood)
SYNC, before the bus not measured
reading, or its SYNC behind the bus 30 400 7.5 5 to 10 9 8 7 6 5 4 3 2 ... to 9 \
p_good_to_bad 0.01 (0.005 to 0.02), p_bad_to_good 0.25 (0.2 to 0.3)
command, before the bus not measured
command, behind the bus not measured
clock: drift +12.35 ppm (+-0.68), offset 1234.6 us (+-7.9), 2 readings uncertain
[note] of 3

Node 4: servo [4]
us p50 p99 p99.9 max within
wake-up lateness 50.0 99.0 100.0 100.0 97.049 % the host's clock
SYNC on the bus not measured: no echo
sample 5.5 5.5 5.5 5.5 5.000 % by the stamp
losses lost of % true % runs of 1, 2, ... model (maximum likelihood)
SYNC, before the bus not measured
reading, or its SYNC behind the bus 1 500 0.2 0.001 to 1.2 8 7 6 5 4 3 2 1 not identifiable: 1 runs
command, before the bus not measured
command, behind the bus 30 300 10 8 to 12 30 independent
clock: the drive puts no stamp beside its speed

Intervals at 95 %. Within the largest: of all delays, those to come included."""


def test_every_drive_is_told_by_stages_losses_and_clock(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert printed(MEASURED, capsys, monkeypatch) == TOLD


def test_what_speaks_against_a_measurement_stands_behind_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = replace(CLOCK, steps=2)
    only = replace(
        MEASURED,
        request=replace(REQUEST, enable=False),
        drives=[replace(MEASURED.drives[0], clock=told, uncertain=0, notes=())],
        surplus=3,
        distrust=["too late", "too few"],
    )
    lines = printed(only, capsys, monkeypatch).splitlines()
    assert lines[0] == "500 cycles of 1000 us on hub:x, drives disabled; 7 went without SYNC"
    assert lines[-6:] == [
        "clock: drift +12.35 ppm (+-0.68), offset 1234.6 us (+-7.9), set 2 times",
        "",
        "Intervals at 95 %. Within the largest: of all delays, those to come included.",
        "3 SYNCs came to the bus after they were given up, and count as lost before it",
        "Not trustworthy: too late",
        "Not trustworthy: too few",
    ]


# ---- the command --------------------------------------------------------------------------------------


class Bench:
    """In place of a bus: what was to be measured, and what came of it."""

    def __init__(self) -> None:
        self.asked: list[MeasureRequest] = []
        self.answer = MEASURED

    def run(self, request: MeasureRequest, tell: Any, _progress: Any) -> Measured:
        tell("the drives are found")
        self.asked.append(request)
        return self.answer


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    made = Bench()
    monkeypatch.setattr(measure, "run_measurement", made.run)
    return made


def hil(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["measure", "--bus", "hub:x", "--node", "3,4", *map(str, arguments)])


def test_the_options_are_the_request(bench: Bench) -> None:
    motor = ROOT / "examples" / "motors" / "ling2012.toml"
    hil()
    hil(
        "7", "--cycles", "900", "--period-us", "2000", "--enable", "--torque-max-nm", "0.5",
        "--speed-max-rpm", "60", "--bitrate", "500000", "--seed", "9", "--motor", motor,
    )  # fmt: skip
    plain = MeasureRequest("hub:x", (3, 4), 10_000, 1000, 1_000_000, False, 100.0 * RAD_S_PER_RPM)
    assert bench.asked == [
        plain,
        MeasureRequest(
            "hub:x", (3, 4, 7), 900, 2000, 500_000, True, 60.0 * RAD_S_PER_RPM, torque_max_nm=0.5,
            motor=LING2012.parameters, seed=9,
        ),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({}, 0),
        ({"distrust": ["x"]}, 1),
        ({"interrupted": True}, 130),
        ({"interrupted": True, "distrust": ["x"]}, 130),
    ],
)
def test_a_measurement_leaves_with_what_is_to_be_thought_of_it(
    bench: Bench, changes: dict[str, Any], status: int
) -> None:
    bench.answer = replace(MEASURED, **changes)
    told = hil("--json")
    assert (told.exit_code, json.loads(told.stdout)) == (status, bench.answer.as_json())
    assert told.stderr == "hil: the drives are found\n"
    assert hil().stdout.startswith("500 cycles of 1000 us on hub:x, drives enabled; 7 went without SYNC\n")


NETWORK = Network(
    period_us=1000, losses_in_a_row_max=2, delay_max_us=700, commands="measured",
    reading_delay_us=DelayFigures(p50=1.0, p99=2.0, p999=3.0, max=4.0),
)  # fmt: skip


def test_files_are_written_of_what_was_measured_to_its_end(bench: Bench, tmp_path: Path) -> None:
    out, faults, drawing = tmp_path / "network.toml", tmp_path / "faults.toml", tmp_path / "stages.svg"
    options = ("--out", out, "--faults-out", faults, "--picture", drawing)
    bench.answer = replace(MEASURED, network=NETWORK, interrupted=True)
    assert hil(*options).exit_code == 130
    assert list(tmp_path.iterdir()) == []
    keys = ("reception", "command_on_bus", "command_acting")
    stages = [stage(key, key, [], "disabled") for key in keys]
    drives = [replace(each, stages=stages) for each in MEASURED.drives]
    bench.answer = replace(MEASURED, network=NETWORK, drives=drives)
    told = hil(*options)
    assert told.exit_code == 0
    written = [f"written: {path}" for path in (out, faults, drawing)]
    assert told.stderr.splitlines() == ["hil: the drives are found", *written]
    assert out.read_text().startswith("# Measured on hub:x by hil measure.\n\n[network]\n")
    assert load_network(out) == NETWORK
    assert faults.read_text() == fault_plan_text(bench.answer)
    assert drawing.read_text().startswith("<?xml")
    out.unlink()
    bench.answer = MEASURED
    assert hil("--out", out).stderr == "hil: the drives are found\n"
    assert not out.exists(), "no reading came, so there is no network"


@pytest.mark.parametrize("option", ["--out", "--faults-out", "--picture"])
def test_a_place_for_a_file_is_looked_at_before_anything_is_measured(
    bench: Bench, option: str, tmp_path: Path
) -> None:
    expected = "expected a file in an existing folder"
    for place in (tmp_path, tmp_path / "none" / "x.png"):
        told = hil(option, place)
        assert (told.exit_code, told.stderr) == (2, f"hil: error: {option}: found '{place}', {expected}\n")
    assert bench.asked == []


def test_a_picture_is_of_a_kind_that_can_be_drawn(bench: Bench, tmp_path: Path) -> None:
    told = hil("--picture", tmp_path / "x.jpg")
    expected = "expected a file that ends in .png, .svg, .pdf"
    assert told.stderr == f"hil: error: --picture: found '{tmp_path / 'x.jpg'}', {expected}\n"
    assert (told.exit_code, bench.asked) == (2, [])


def test_each_stage_that_was_measured_is_drawn_with_its_quantiles(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path, dpi: drawn.append((self, path, dpi)))
    picture.draw_stages(tmp_path / "x.png", MEASURED)
    ((figure, path, dpi),) = drawn
    assert (path, dpi, tuple(figure.get_size_inches())) == (tmp_path / "x.png", 110, (8.0, 1.3 * 3 + 0.4))
    axes = figure.axes
    titles = ["wake-up lateness", "node 3: sample", "node 4: sample"]
    assert [ax.get_title(loc="left") for ax in axes] == titles
    assert [ax.get_xlabel() for ax in axes] == ["", "", "us; lines: p50, p99 (dashed), p99.9 (dotted)"]
    assert {(ax.get_yscale(), ax.get_ylim()[0]) for ax in axes} == {("log", 0.5)}
    lines = [(round(line.get_xdata()[0]), line.get_linestyle()) for line in axes[0].get_lines()]
    assert lines == [(50, "-"), (99, "--"), (100, ":")]
    (stairs,) = axes[0].patches
    data = stairs.get_data()
    assert (data.values.sum(), data.edges[0], data.edges[-1]) == (100, 1.0, 100.0)
