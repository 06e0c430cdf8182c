"""Whole commissionings of drives drawn from a seed, in simulated time: is what was hidden found."""

import base64
import json
import math
import re
from html.parser import HTMLParser
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, supported_mode_bit
from servobench.drivers.sheets.dictionary import load_dictionary
from servobench.hil.cli import app
from servobench.hil.commissioning.findings import StepVerdict
from servobench.hil.commissioning.report import REPORT_FILE
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.configuration.drive_file import load_drive_file
from servobench.hil.configuration.motor_file import load_motor
from servobench.hil.configuration.network_file import load_network
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.benchmarks.bench_commissioning import row, within
from tests.commissioning import LATE, LOSS, errors_of, unknown_world
from tests.draws import few_of
from tests.rehearsals.rehearsal import made_sheet, rehearsed


class Page(HTMLParser):
    """An HTML file as a foreign reader sees it."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.text = ""
        self.links: list[str] = []
        self._pictures: list[bytes] = []
        self.feed(source)

    @property
    def pictures(self) -> list[bytes]:
        """Of the data URIs, in order of their bytes."""
        return sorted(self._pictures)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Pictures inside, and whatever leads outside."""
        for name, value in attrs:
            if name in ("src", "href"):
                head, _, data = str(value).partition(";base64,")
                if tag == "img" and head == "data:image/png":
                    self._pictures.append(base64.b64decode(data))
                else:
                    self.links.append(str(value))

    def handle_data(self, data: str) -> None:
        """What is to be read."""
        self.text += data + " "


@pytest.mark.parametrize(
    ("seed", "hidden"),
    few_of([(10, {"polarity", "position", "torque"}), (3, {"polarity", "position", "velocity"})], 1),
)
def test_what_is_hidden_is_found(tmp_path: Path, seed: int, hidden: set[str]) -> None:
    truth, result, spy = unknown_world(seed, tmp_path, spied=True)
    assert truth.faults == hidden
    assert [(r.name, r.reason) for r in result.records if r.verdict is not StepVerdict.DONE] == []
    errors = errors_of(truth, result, spy)
    assert within(errors), row(seed, errors)
    voltage = next(record.outcome.figures for record in result.records if record.name == "voltage_constant")
    constant = truth.motor.pole_pairs * truth.motor.flux_linkage_wb
    assert constant < voltage["voltage_constant_below"] < 6.0 * constant
    assert voltage["by_torque_constant"] == pytest.approx(constant, rel=0.01)
    assert result.left.restoration is not None
    assert result.left.restoration.complete
    assert result.passed


def test_the_same_with_lost_frames_and_a_drifting_clock(tmp_path: Path) -> None:
    """Seed 14 tells a velocity a hundred times too fast: a lost position must not be made up by it."""
    truth, result, spy = unknown_world(14, tmp_path, faults=LOSS, drift_ppm=300.0, spied=True)
    assert truth.faults == {"polarity", "velocity"}
    errors = errors_of(truth, result, spy)
    assert within(errors), row(14, errors)
    network = load_network(tmp_path / "network.toml")
    assert 0.5 < network.loss_percent < 4.0, "1 % each way of SYNC and readings"
    assert network.losses_in_a_row_max >= 1
    delays = next(record for record in result.records if record.name == "delays")
    assert delays.outcome.figures["commands_lost"] > 0


def test_a_velocity_that_scatters_is_watched_over_a_longer_path(tmp_path: Path) -> None:
    """Seed 88 has 4000 counts a turn and tells a position unit of ten: a pulse of a quarter of a turn is one
    of a fortieth, over which the encoder's steps in 606Ch are several percent."""
    truth, result, _ = unknown_world(88, tmp_path, last_step="turn")
    found = result.findings
    assert found.override.velocity_rad_s == pytest.approx(truth.velocity_rad_s, rel=1e-3)
    units = next(record for record in result.records if record.name == "motion_units")
    assert 0.0 < units.outcome.figures["velocity_over_path_error"] < 0.1
    assert "(k = 2)" in units.outcome.lines[0]


def test_a_turn_is_right_whenever_its_readings_arrive(tmp_path: Path) -> None:
    truth, result, _ = unknown_world(1, tmp_path, faults=LATE, period_us=10_000, last_step="turn")
    (turn,) = (record for record in result.records if record.name == "turn")
    assert turn.outcome.figures["units_per_turn"] == pytest.approx(math.tau / truth.position_rad, rel=3e-4)


def test_a_drive_without_torque_mode_gets_the_steps_that_it_allows(tmp_path: Path) -> None:
    only = supported_mode_bit(Mode.CYCLIC_SYNCHRONOUS_VELOCITY) | supported_mode_bit(Mode.HOMING)
    truth, result, _ = unknown_world(3, tmp_path, modes=only)
    verdicts = {record.name: record.verdict for record in result.records}
    assert verdicts["mechanics"] is StepVerdict.DONE
    left_out = [name for name, verdict in verdicts.items() if verdict is StepVerdict.LEFT_OUT]
    assert left_out == ["torque_constant", "voltage_constant", "response", "suggest", "verify"]
    assert not [name for name, verdict in verdicts.items() if verdict is StepVerdict.FAILED]
    assert result.left.restoration is not None
    assert result.left.restoration.complete
    errors = errors_of(truth, result)
    assert abs(errors.inertia) < 0.03
    assert abs(errors.position) < 0.005
    assert abs(errors.velocity) < 0.005
    report = (tmp_path / REPORT_FILE).read_text()
    assert "the drive has no torque mode" in report.split("## Left out")[1]


def test_in_profile_torque_the_slope_is_named_that_rules_the_delay(tmp_path: Path) -> None:
    sheet = made_sheet(["6087h is 1000 at most"], tmp_path)
    result = rehearsed(sheet, tmp_path, last_step="delays")
    assert "torque slope 6087h" in result.not_done["delays"]
    assert "1000 thousandths a second" in result.not_done["delays"]


def test_the_command_leaves_files_that_a_bench_can_use(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["commission", "--bus", "simulated", "--node", "5", "--rehearse", "4", "--yes", "--json"]
    done = CliRunner().invoke(app, [*command, "--out", str(out), "--period-us", "4000"])
    assert done.exit_code == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["restored"] is True
    assert {step["verdict"] for step in figures["steps"]} == {"done"}
    assert json.loads((out / "figures.json").read_text()) == figures

    _, truth = unknown_drive(4)
    motor = load_motor(out / "motor.toml").parameters
    assert motor.inertia_kg_m2 == pytest.approx(truth.motor.inertia_kg_m2, rel=0.03)
    assert motor.torque_constant_nm_a == pytest.approx(truth.motor.torque_constant_nm_a, rel=0.01)
    said = "Not measurable over CiA 402, by the nameplate: resistance, inductance, pole pairs."
    assert said in (out / "motor.toml").read_text()
    drive = load_drive_file(out / "drive.toml")
    assert drive.drive.node == 5
    assert drive.scale.rated_torque_nm == pytest.approx(truth.rated_torque_nm)
    assert drive.current_loop is not None
    measured_s, built_s, tick_s = (
        1.0 / (math.tau * drive.current_loop.bandwidth_hz),
        1.0 / (math.tau * 800),
        1 / 16_000,
    )
    # it waits for its next tick, and shows its torque as of the last one: half a tick each in the mean,
    # between none and two by when in a tick the SYNCs fall
    assert measured_s == pytest.approx(built_s + tick_s, abs=tick_s)
    assert load_network(out / "network.toml").period_us == 4000
    sheet: Any = load_dictionary(out / "drive.dcf", 5).dictionary
    assert sheet[Object.POLARITY].value == 0
    assert sheet[0x1016][1].value >> 16 == 127
    assert "the rehearsed drive's own nameplate is taken" in done.stderr
    assert "1 frame in" in done.stderr
    assert f"see {out / 'report.html'}" in done.stderr
    assert "{'" not in (out / REPORT_FILE).read_text(), "no table of Python's"
    text = (out / "bench.toml").read_text()
    assert not [number for number in re.findall(r"-?\d+\.\d+", text) if len(number.strip("-0.")) > 7], text
    bench = load_bench(out / "bench.toml")
    assert bench.verdict.limits.speed_error_rms_rad_s_max is not None
    assert bench.drive["axis1"].commissioned == drive
    ran = CliRunner().invoke(app, ["run", str(out / "bench.toml"), "--no-record"])
    assert ran.exit_code == 0, ran.stderr
    report = (out / REPORT_FILE).read_text()
    for step in figures["steps"]:
        assert step["figures"] is not None
    for picture in out.glob("plots/*.png"):
        assert f"(plots/{picture.name})" in report
    # at 4 ms the shaft is too fast from sample to sample for a picture over its angle
    drawn = {picture.stem for picture in out.glob("plots/*.png")}
    assert drawn == {"mechanics", "torque_constant", "response", "delays", "verify"}
    html = Page((out / "report.html").read_text())
    assert html.pictures == sorted(path.read_bytes() for path in out.glob("plots/*.png"))
    assert not html.links, "it is one file"
    for text in (version("servobench"), "1018h:4", "1000000", "inertia", "kg m^2", "607E:00", "hil restore"):
        assert text in html.text
    assert figures["header"]["date"][:4] in html.text
    quantities = {each["name"]: each for step in figures["steps"] for each in step["quantities"]}
    assert quantities["inertia"]["uncertainty"] > 0.0
    written = {each["object"]: each for each in figures["written"]}
    assert written["607E:00"]["set"] == "00"
    assert written["607E:00"]["before"] not in ("", "00")
    assert "byte for byte" in report


def test_a_dry_run_writes_nothing_and_moves_nothing(tmp_path: Path) -> None:
    servo, _ = unknown_drive(3)
    out = tmp_path / "out"
    command = ["commission", "--bus", "simulated", "--node", "1", "--rehearse", "3", "--dry-run"]
    done = CliRunner().invoke(app, [*command, "--out", str(out)])
    assert done.exit_code == 0, done.stderr
    assert "raise the torque slowly" in done.stderr
    assert not (out / "journal.jsonl").exists()
    assert "nothing was written" in (out / REPORT_FILE).read_text()
    del servo


def test_store_keeps_the_settings_and_says_so(tmp_path: Path) -> None:
    truth, result, _ = unknown_world(4, tmp_path, period_us=4000, store=True, last_step="turn")
    assert result.left.stored
    assert result.left.restoration is None
    assert "stored in the drive" in (tmp_path / REPORT_FILE).read_text()
    assert truth.faults


def test_a_drive_that_does_not_store_is_not_said_to_have_stored(tmp_path: Path) -> None:
    said: list[str] = []
    _, result, _ = unknown_world(
        4, tmp_path, period_us=4000, store=True, lacks=["1010"], tell=said.append, last_step="turn"
    )
    assert not result.left.stored
    assert not result.passed
    assert any("hil restore" in text for text in said), "what puts it back"
    assert "NOT stored in the drive" in (tmp_path / REPORT_FILE).read_text()
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["stored"] is False
    assert "1010h" in figures["not_stored"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--bus", "simulated"], "--rehearse"),
        (["--bus", "hub:x", "--rehearse", "1"], "--rehearse"),
        (["--bus", "nonsense"], "--bus"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path: Path, options: list[str], said: str) -> None:
    done = CliRunner().invoke(app, ["commission", "--node", "1", "--out", str(tmp_path), "--yes", *options])
    assert done.exit_code == 2
    assert said in done.stderr


def test_a_file_is_no_folder_for_the_recording(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("mine")
    where = str(tmp_path / "taken" / "log")
    command = ["commission", "--bus", "simulated", "--rehearse", "1", "--node", "1", "--yes", "--out", where]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 2
    assert "a place to write to" in done.stderr


def test_without_a_terminal_somebody_has_to_say_yes(tmp_path: Path) -> None:
    command = ["commission", "--bus", "simulated", "--rehearse", "1", "--node", "1", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 2
    assert "--yes" in done.stderr


def test_half_of_the_readings_lost_is_no_step_done(tmp_path: Path) -> None:
    half = [{"direction": "drive_to_host", "probability": 0.5}]
    _, result, _ = unknown_world(4, tmp_path, faults={"loss": half}, last_step="polarity")
    polarity = next(record for record in result.records if record.name == "polarity")
    assert polarity.verdict is StepVerdict.FAILED
    assert "readings were lost" in polarity.reason
    assert not result.passed


def test_a_drive_that_tells_no_torque_is_identified_by_the_commanded_one(tmp_path: Path) -> None:
    truth, result, _ = unknown_world(4, tmp_path, lacks=("6077", "6078"), period_us=4000)
    verdicts = {record.name: record.verdict for record in result.records}
    left_out = [name for name, verdict in verdicts.items() if verdict is StepVerdict.LEFT_OUT]
    assert left_out == ["torque_constant"]
    assert result.passed
    errors = errors_of(truth, result)
    assert abs(errors.inertia) < 0.01
    assert 0.1 < errors.inertia_stated < 0.12, "what the drive makes of a command nobody has measured"
    effect_us = result.findings.effect_delay_us
    assert effect_us is not None
    assert 200.0 < effect_us < 600.0


def test_without_any_torque_what_needs_no_inertia_is_done(tmp_path: Path) -> None:
    only = supported_mode_bit(Mode.CYCLIC_SYNCHRONOUS_VELOCITY) | supported_mode_bit(Mode.HOMING)
    _, result, _ = unknown_world(3, tmp_path, modes=only, lacks=("6077", "6078"), period_us=4000)
    verdicts = {record.name: record.verdict for record in result.records}
    assert verdicts["mechanics"] is StepVerdict.LEFT_OUT
    assert verdicts["turn"] is verdicts["delays"] is StepVerdict.DONE
    assert not [name for name, verdict in verdicts.items() if verdict is StepVerdict.FAILED]
    assert "nan" not in (tmp_path / REPORT_FILE).read_text().lower().split()


def test_a_nameplate_that_the_drive_contradicts_by_far_is_refused_unasked(tmp_path: Path) -> None:
    """Seed 1 tells its ratings truly; the plate is that of a motor ten times as large."""
    _, truth = unknown_drive(1)
    assert "torque" not in truth.faults
    rating = truth.nameplate["rating"]
    larger = {key: 10.0 * rating[key] for key in ("torque_nm", "current_a")}
    plate = {"rating": {**rating, **larger}}
    _, result, _ = unknown_world(1, tmp_path, plate=plate, trust_nameplate=False)
    units = next(record for record in result.records if record.name == "units")
    assert units.verdict is StepVerdict.FAILED
    assert "--trust-nameplate" in units.reason
    assert result.records[-1] is units, "nothing has moved"


def test_counts_are_not_taken_against_the_drive_without_a_turn(tmp_path: Path) -> None:
    """Seed 5 tells everything truly; without homing and with nobody there no turn can be measured."""
    _, truth = unknown_drive(5)
    assert not truth.faults
    counts = round(4.0 * math.tau / truth.position_rad)
    plate = {**truth.nameplate, "encoder": {"counts_per_revolution": counts}}
    only = supported_mode_bit(Mode.CYCLIC_SYNCHRONOUS_TORQUE)
    _, result, _ = unknown_world(
        5, tmp_path, modes=only, plate=plate, trust_nameplate=False, period_us=4000, last_step="turn"
    )
    step = next(record for record in result.records if record.name == "turn")
    assert step.verdict is StepVerdict.FAILED
    assert step.reason.startswith("encoder: the nameplate says")
    assert result.findings.override.position_rad is None
