"""[Ling2012] from the command line: the file that a bench runs, and the reproduction."""

import math
from pathlib import Path
from typing import Any

import pytest

from servobench.design.delay.delay_loop import Units
from servobench.design.papers.ling2012 import (
    LOAD_NM,
    LOAD_ON_S,
    LOSSES,
    PERIOD_S,
    PID_DELAY_S,
    TABLE_2,
    TAU_S,
    K,
    pi_gains,
    table2_row,
)
from servobench.design.papers.ling2012 import MOTOR as MOTOR_OF_PAPER
from servobench.drivers.bounded_file import read_toml
from servobench.drivers.errors import LimitExceeded
from servobench.hil.configuration.bench_file import bench_from, load_bench, load_controller
from servobench.hil.configuration.network_file import load_network
from servobench.hil.execution.bench import run_bench
from servobench.hil.studies.papers import reproduction
from servobench.hil.studies.papers.reproduction import LOAD_AT_S, VARIANTS, bench_of
from tests.unit.hil.test_speed_studies import HAND_WRITTEN, MOTOR, run, told

EXAMPLES = Path(__file__).parents[2] / "examples"
ROW_KEYS = {
    "error_percent", "gamma", "published_delay_s", "ccl_delay_s", "lmi_delay_s",
    "exact_speed_feedback_delay_s", "exact_delay_s", "gain",
}  # fmt: skip


@pytest.fixture(scope="module")
def unviewed_recordings() -> None:
    """None: run.rrd is looked at."""


def _designed_bench(controller: Path, loss: float) -> dict[str, Any]:
    tables = read_toml(EXAMPLES / "network_designed.toml", "bench file")
    tables["bench"]["duration_s"] = 1.0
    tables["drive"]["axis1"] |= {"motor": MOTOR, "controller": str(controller)}
    # the readings alone: a statusword that was not told for long stops a run by itself
    tables["faults"]["loss"][0] |= {"probability": loss, "frames": [0x181]}
    del tables["load"]
    return tables


@pytest.mark.timeout(300)  # certificates over all sequences: half a minute of processor, longer beside others
def test_from_measured_network_to_running_controller(tmp_path: Path) -> None:
    measured, controller = tmp_path / "measured", tmp_path / "k.toml"
    tables = read_toml(EXAMPLES / "network_measured.toml", "bench file")
    tables["bench"]["duration_s"] = 1.0
    tables["drive"]["axis1"]["motor"] = MOTOR
    _bench(tables, measured)
    network = load_network(measured / "network.toml")
    assert network.period_us == 2000
    assert network.lost == sum((k + 1) * runs for k, runs in enumerate(network.losses_in_a_row))
    assert 300 < network.delay_max_us < 2000
    status, _, err = run(
        "design", "speed", MOTOR, "--network", str(measured / "network.toml"), "--feedback", "speed",
        "--bench", str(measured / "bench.toml"), "--extra-losses", "1", "--delay-margin-percent", "5",
        "--out", str(controller),
    )  # fmt: skip
    assert status == 0, err
    config = bench_from(_designed_bench(controller, 0.05), "bench.toml", tmp_path)
    made = config.drive["axis1"].controller
    assert made.kind == "state_feedback"
    assert made.made_for is not None
    assert made.made_for.losses_in_a_row_max == network.losses_max + 1
    assert made.certificate is not None
    sequences = made.certificate.sequences
    assert sequences is not None
    assert sequences.step_peak_certified_rad_s is not None
    assert sequences.step_peak_found_rad_s is not None
    assert sequences.step_peak_certified_rad_s >= sequences.step_peak_found_rad_s
    _bench(_designed_bench(controller, 0.05), tmp_path / "good")
    again = load_bench(tmp_path / "good" / "bench.toml")
    assert again.drive["axis1"].controller == made

    with pytest.raises(LimitExceeded, match="readings lost in a row"):
        _bench(_designed_bench(controller, 0.6), tmp_path / "worse")
    noted = _bench(_designed_bench(controller, 0.6), tmp_path / "warned", allow_uncertified=True)
    assert any("readings lost in a row" in note for note in noted["network_notes"])
    bench_toml = str(tmp_path / "good" / "bench.toml")
    worse = str(tmp_path / "warned" / "network.toml")
    status, _, err = run("run", bench_toml, "--network", worse, "--record", str(tmp_path / "refused"))
    assert status == 2
    assert "losses_in_a_row_max" in err
    assert not (tmp_path / "refused").exists()


def _bench(tables: dict[str, Any], record: Path, **options: Any) -> dict[str, Any]:
    summary = run_bench(bench_from(tables, "bench.toml", Path()), record=record, **options)
    return summary.as_json()


def test_the_sampled_loop_itself_is_made_best(tmp_path: Path) -> None:
    network, out = tmp_path / "n.toml", tmp_path / "k.toml"
    network.write_text(HAND_WRITTEN.replace("losses_in_a_row_max = 1", "losses_in_a_row_max = 0"))
    asked = ("design", "speed", MOTOR, "--network", str(network), "--feedback", "speed")
    constant = told(*asked)
    sampled = told(*asked, "--target", "sampled", "--out", str(out))
    assert sampled["gamma"] < 0.97 * constant["sampled"]["sequences"]["gain"]["certified"]
    assert sampled["sampled"]["certified"] is True
    assert sampled["sampled"]["sequence_certificate"]["min_margin"] > 0.0
    written = read_toml(out, "controller file")["controller"]
    assert written["certificate"]["target"] == "sampled"
    assert written["gain"] == sampled["gain"]
    assert load_controller(out).kind == "state_feedback"


@pytest.mark.parametrize(("case", "name"), VARIANTS)
def test_the_benches_of_the_reproduction_have_the_figures_of_the_paper(case: str, name: str) -> None:
    bench = read_toml(bench_of(case, name), "bench file")
    drive, faults = bench["drive"]["axis1"], bench["faults"]
    winding_hz = MOTOR_OF_PAPER.resistance_ohm / MOTOR_OF_PAPER.inductance_q_h / math.tau
    assert drive["simulation"]["current_bandwidth_hz"] == pytest.approx(winding_hz, abs=1e-4)
    assert bench["loop"]["period_us"] == 1e6 * PERIOD_S
    assert faults["delay"][0]["delay_us"] == 1e6 * (PID_DELAY_S if case == "case2" else TAU_S)
    lossless = case == "case2" or name == "history"
    assert [each["lost"] for each in faults.get("periodic_loss", ())] == ([] if lossless else [LOSSES])
    controller = drive["controller"]
    if case == "case2":
        gains = controller["proportional_nm_s_rad"], controller["integral_nm_rad"]
        assert gains == pi_gains({"pi_careful": 60.0, "pi_eager": 200.0}[name])
    else:
        assert controller["gain"] == K.tolist()
    if case == "case3":
        on, off = bench["load"]["axis1"]
        assert (on["at_s"], on["torque_nm"], off["at_s"]) == (LOAD_AT_S, LOAD_NM, LOAD_AT_S + LOAD_ON_S)


def test_reproduction(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    error_percent, printed_s = TABLE_2[0]

    def one_row() -> dict[str, list[dict[str, Any]]]:
        row = table2_row(error_percent, printed_s, Units.PUBLISHED)
        return {"published": [row], "si": [row]}

    known = {"by_losses": [{"lost": 0, "decay_per_s": 1.0, "gamma": None}]}
    monkeypatch.setattr(reproduction, "table2", one_row)
    monkeypatch.setattr(reproduction, "strategies", lambda: {"arrival": known, "history": known})
    monkeypatch.setattr(reproduction, "VARIANTS", (VARIANTS[0], *VARIANTS[4:]))
    found = told("reproduce", "ling2012", "--figures", str(tmp_path))
    assert set(found) >= {"table2", "published_design", "case1", "case2", "case3"}
    (row,) = found["table2"]["published"]
    assert set(row) >= ROW_KEYS
    assert row["published_delay_s"] == 0.082
    assert row["lmi_delay_s"] == pytest.approx(0.074099, abs=1e-5)
    assert len(list(tmp_path.glob("*.png"))) == 5
    stamp, arrival, history = (found["case3"]["bench"][name] for name in ("stamp", "arrival", "history"))
    # nobody gets below what the load does while nothing can act; arrival is back three times as fast
    assert all(run["peak_percent"] > 19.0 for run in (stamp, arrival, history))
    assert arrival["recovery_5_percent_s"] < 0.5 * history["recovery_5_percent_s"]
    assert history["recovery_5_percent_s"] < stamp["recovery_5_percent_s"]
    assert (Path(stamp["recording"]) / "run.rrd").exists()
