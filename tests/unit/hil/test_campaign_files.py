"""Sweep files and folders of campaigns: messages of what is refused, ranges, labels, the table's columns."""

import json
import tempfile
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.campaign.identity import digest_of, opened_files
from servobench.hil.campaign.plan import CampaignPlan, Proposal, fitted
from servobench.hil.campaign.store import open_campaign, plan_in, schema_of
from servobench.hil.campaign.sweep_file import sweep_from
from servobench.hil.campaign.worker import FIGURES
from servobench.hil.configuration.config_files import bad_inputs_of, toml_text
from tests.unit.hil.test_campaign_plan import GAIN, INERTIA, LING, LOSS, plan, tables

KEY = "loop.deadline_us"
RANGE = {"key": KEY, "from": 1000.0, "to": 2000.0, "count": 3}
SHAPES = "one of: values; rows beside keys; or from, to and count"
KEYS = "key beside values or a range, keys beside rows"
NORMAL = {"key": KEY, "distribution": "normal", "mean": 2.0, "deviation": 1.0}
UNIFORM = {"key": KEY, "distribution": "uniform", "low": 1.0, "high": 2.0}
LOW_HIGH = "low and high for {}, and no other of them"
MEAN = "mean and deviation for normal, and no other of them"


def without(table: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in table.items() if name not in names}


def refusal(more: dict[str, Any]) -> BadInput:
    with pytest.raises(Exception) as caught:
        sweep_from(tables(**more), "sweep.toml")
    (error,) = bad_inputs_of(caught.value)  # type: ignore[arg-type]
    return error


@pytest.mark.parametrize(
    ("vary", "expected"),
    [
        ({"key": KEY, "values": [1], "rows": [[1]]}, SHAPES),
        ({**RANGE, "values": [1]}, SHAPES),
        (without(RANGE, "count"), SHAPES),
        (without(RANGE, "from"), SHAPES),
        ({"key": KEY, "values": [1], "count": 2}, SHAPES),
        ({"keys": [KEY], "values": [1]}, KEYS),
        ({"values": [1]}, KEYS),
        ({"key": KEY, "rows": [[1]]}, KEYS),
        ({"key": KEY, "keys": [KEY], "rows": [[1]]}, KEYS),
        ({"keys": ["a", "b"], "rows": [[1, 2], [3]]}, "in each of rows 2 values, one for each of keys"),
        ({**RANGE, "from": 0.0, "spacing": "log"}, "from and to above 0 where the spacing is log"),
        ({**RANGE, "to": -1.0, "spacing": "log"}, "from and to above 0 where the spacing is log"),
        ({"key": KEY, "values": [1, 2], "labels": ["a"]}, "as many labels as values"),
        ({**RANGE, "labels": ["a", "b"]}, "as many labels as values"),
        ({"keys": [KEY], "rows": [[1], [2]], "labels": ["a", "b", "c"]}, "as many labels as values"),
    ],
)
def test_an_axis_is_of_one_kind(vary: dict[str, Any], expected: str) -> None:
    error = refusal({"vary": [vary]})
    assert (error.source, error.key) == ("sweep.toml", "vary[0]")
    assert error.expected == expected


@pytest.mark.parametrize(
    ("draw", "expected"),
    [
        (without(UNIFORM, "low"), LOW_HIGH.format("uniform")),
        ({**UNIFORM, "mean": 1.0}, LOW_HIGH.format("uniform")),
        ({**UNIFORM, "deviation": 1.0}, LOW_HIGH.format("uniform")),
        (without(NORMAL, "mean"), MEAN),
        (without(NORMAL, "deviation"), MEAN),
        ({**NORMAL, "high": 1.0}, MEAN),
        ({**UNIFORM, "high": 1.0}, "low below high"),
        ({**UNIFORM, "low": 3.0}, "low below high"),
        ({**UNIFORM, "low": 0.0, "distribution": "log_uniform"}, "low above 0 for log_uniform"),
    ],
)
def test_a_draw_has_the_parameters_of_its_distribution(draw: dict[str, Any], expected: str) -> None:
    error = refusal({"draw": [draw]})
    assert (error.source, error.key, error.expected) == ("sweep.toml", "draw[0]", expected)


SEEDS = "campaign.seeds and campaign.first_seed for the seeds"
INDEPENDENT = "random: an end when enough was seen takes draws that do not depend on each other"
TABLES = "tables [[draw]] or [[twin]] and none [[vary]] beside [adaptive]: it is over what is drawn"
ADAPTIVE = {"adaptive": {"guide": "g", "round_runs": 20}, "draw": [UNIFORM]}


@pytest.mark.parametrize(
    ("more", "key", "value", "expected"),
    [
        ({"vary": [LOSS], "draw": [{**UNIFORM, "key": LOSS["key"]}]}, "vary", LOSS["key"], "each key once"),
        ({"change": {"bench.seed": 4}}, "vary", "bench.seed", SEEDS),
        ({"draw": [{**UNIFORM, "key": "bench.seed"}]}, "vary", "bench.seed", SEEDS),
        (
            {"draw": [UNIFORM], "drawing": {"method": "sobol"}, "campaign": {"seeds": 12}},
            "campaign.seeds",
            12,
            "a power of two: points of drawing.method sobol are balanced only then",
        ),
        (
            {"drawing": {"method": "latin_hypercube"}, "stop": {"rate_width": 0.1}},
            "drawing.method",
            "latin_hypercube",
            INDEPENDENT,
        ),
        (without(ADAPTIVE, "draw"), "draw", 0, TABLES),
        ({**ADAPTIVE, "vary": [LOSS], "campaign": {"seeds": 40}}, "vary", 1, TABLES),
        (
            {**ADAPTIVE, "campaign": {"seeds": 39}},
            "campaign.seeds",
            39,
            "40 at least, two rounds of adaptive.round_runs",
        ),
        (
            {**ADAPTIVE, "campaign": {"seeds": 64}, "drawing": {"method": "sobol"}},
            "drawing.method",
            "sobol",
            "random beside [adaptive]",
        ),
        (
            {**ADAPTIVE, "campaign": {"seeds": 40}, "stop": {"rate_width": 0.1}},
            "stop.rate_width",
            0.1,
            "none beside [adaptive]",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(
    more: dict[str, Any], key: str, value: object, expected: str
) -> None:
    error = refusal(more)
    assert (error.source, error.key, error.value, error.expected) == ("sweep.toml", key, value, expected)


def test_what_goes_together_is_taken() -> None:
    for more in (
        {"campaign": {"seeds": 16}, "draw": [UNIFORM], "drawing": {"method": "sobol"}},
        {**ADAPTIVE, "campaign": {"seeds": 40}},
        {"stop": {"rate_width": 0.1}, "draw": [NORMAL], "campaign": {"seeds": 12}},
        {"vary": [{**RANGE, "spacing": "log", "labels": ["a", "b", "c"]}]},
    ):
        assert sweep_from(tables(**more), "sweep.toml").campaign.name == "try"


def axis(**vary: Any) -> Any:
    return plan(vary=[vary]).axes[0]


def test_a_range_is_even_in_its_spacing() -> None:
    whole = axis(**{**RANGE, "to": 2001.0, "whole": True})
    assert whole.numbers == (1000.0, 1500.0, 2001.0)
    assert [choice[KEY] for choice in whole.choices] == [1000, 1500, 2001]
    assert all(isinstance(choice[KEY], int) for choice in whole.choices)
    gain = axis(**{**GAIN, "to": 0.45, "spacing": "log"})
    assert gain.numbers == pytest.approx((0.05, 0.15, 0.45))
    assert axis(**GAIN).numbers == pytest.approx((0.05, 0.125, 0.2))


def test_choices_are_told_by_number_kind_file_or_label() -> None:
    assert axis(key=KEY, values=[900, 1000]).labels == ("900", "1000")
    named = axis(key=KEY, values=[900, 1000], labels=["early", "late"])
    assert (named.labels, named.numbers) == (("early", "late"), None)
    told = axis(key="loop.actuation", values=["on_arrival", "on_sync"])
    assert (told.labels, told.numbers) == (("on_arrival", "on_sync"), None)
    motors = axis(key="drive.axis1.motor", values=["motors/ling2012.toml"])
    assert motors.labels == ("ling2012",)
    kinds = axis(key="faults", values=[{"plan": "faults/jitter.toml"}, {"loss": [{"probability": 0.1}]}])
    assert kinds.labels == ("faults/jitter.toml", '{"loss": [{"probability": 0.1}]}')


def test_a_point_is_told_by_what_varies_there() -> None:
    found = plan(vary=[LOSS, {"key": "loop.actuation", "values": ["on_arrival"]}], draw=[INERTIA])
    assert found.point_title(1) == f"{LOSS['key']} = 0.1, loop.actuation = on_arrival"
    assert plan(draw=[INERTIA]).point_title(0) == ""
    assert (found.known, found.count) == (3, 3)


def test_runs_of_adaptive_draws_are_known_a_round_at_a_time() -> None:
    found = plan(
        campaign={"seeds": 40},
        draw=[INERTIA],
        adaptive={"guide": "speed_error_peak_percent", "round_runs": 20},
    )
    assert (found.known, found.count) == (20, 40)
    assert found.rounds is not None
    found.rounds.take(
        {"run": n, "passed": n > 4, "speed_error_peak_percent": None if n == 3 else 20.0 - n}
        for n in range(20)
    )
    assert found.known == 40
    run = found.run(30)
    assert (run.counts, found.run(5).counts, found.run(5).weight) == (True, False, 1.0)
    assert run.weight != 1.0
    given = found.run(30, found.drawn(30))
    assert given == run


def test_a_proposal_is_fitted_to_the_runs_nearest_to_failing() -> None:
    z = np.arange(20.0)[:, None] / 10.0
    guide, failed = np.arange(20.0), np.arange(20) >= 14
    elite = fitted(z, np.ones(20), guide, failed, "failures")
    assert elite.centres[:, 0].tolist() == z[14:, 0].tolist(), "six failed, more than a fifth"
    few = fitted(z, np.ones(20), guide, np.arange(20) >= 18, "failures")
    assert few.centres[:, 0].tolist() == z[16:, 0].tolist(), "a fifth at the least"
    edge = fitted(z, np.ones(20), guide, failed, "boundary")
    assert edge.centres[:, 0].tolist() == z[12:16, 0].tolist(), "on both sides"
    assert (elite.nominal_share, edge.nominal_share) == (0.1, 0.5)
    heavy = np.where(np.arange(20) == 19, 4.0, 1.0)
    shares = fitted(z, heavy, guide, failed, "failures").shares
    assert shares == pytest.approx([1 / 7] * 5 + [2 / 7])
    deviation = np.sqrt(0.7**2 * np.var(z[14:, 0]) + 0.3**2)
    assert elite.factor == pytest.approx(np.array([[deviation]]))


def test_weights_put_a_mixture_right() -> None:
    """Against the two densities themselves."""
    centres, factor = np.array([[1.0, 0.5], [2.0, -1.0]]), np.array([[0.6, 0.0], [0.2, 0.4]])
    proposal = Proposal(0.25, centres, np.array([0.25, 0.75]), factor)
    z = np.array([[0.0, 0.0], [1.5, -0.5], [-2.0, 1.0]])
    covariance = factor @ factor.T

    def density(point: np.ndarray, centre: np.ndarray, spread: np.ndarray) -> float:
        apart = point - centre
        exponent = -0.5 * apart @ np.linalg.inv(spread) @ apart
        return float(np.exp(exponent) / (2 * np.pi * np.sqrt(np.linalg.det(spread))))

    for point, weight in zip(z, proposal.weights(z), strict=True):
        nominal = density(point, np.zeros(2), np.eye(2))
        kernels = 0.25 * density(point, centres[0], covariance) + 0.75 * density(
            point, centres[1], covariance
        )
        assert weight == pytest.approx(nominal / (0.25 * nominal + 0.75 * kernels))


def test_draws_of_a_proposal_are_of_its_mixture() -> None:
    centres = np.array([[10.0], [20.0]])
    proposal = Proposal(0.2, centres, np.array([0.25, 0.75]), np.array([[0.5]]))
    drawn = proposal.draw(4_000, np.random.default_rng(3))[:, 0]
    near = [int((np.abs(drawn - centre) < 4.5).sum()) / 4_000 for centre in (0.0, 10.0, 20.0)]
    assert near == pytest.approx([0.2, 0.2, 0.6], abs=0.03)
    assert drawn[np.abs(drawn - 20.0) < 4.5].std() == pytest.approx(0.5, rel=0.1)


def written(folder: Path, **more: Any) -> Path:
    path = folder / "sweep.toml"
    path.write_text(toml_text(tables(vary=[LOSS], **more)))
    return path


def test_the_columns_of_a_campaign_have_units_and_meanings(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("def check(seed, run):\n    return []\n")
    path = written(
        tmp_path,
        own={"check": "own.py:check"},
        draw=[{**UNIFORM, "low": 1000.0, "high": 2000.0, "whole": True}],
    )
    found = schema_of(CampaignPlan.load(path))
    labels = [LOSS["key"], KEY]
    told = ["weight", "counts", "outcome", "passed", "completed", "reason", "certificate", "premises_left"]
    told += ["premises_unknown", "digest"]
    assert found.names == ["run", "point", "replicate", "seed", *labels, *told, *FIGURES, "findings"]
    assert found.field(KEY).metadata == {b"meaning": b"it varies", b"unit": b"us"}
    assert found.field("run").metadata == {b"meaning": b"number of the run, from 0"}
    assert found.field("findings").type == pa.list_(pa.string())
    assert found.metadata[b"format"] == b"3"
    assert json.loads(found.metadata[b"sweep"])["campaign"]["bench"] == str(LING)
    texts = schema_of(plan(vary=[{"key": "loop.actuation", "values": ["on_sync", "on_arrival"]}]))
    assert texts.field("loop.actuation").type == pa.string()
    assert b"unit" not in texts.field("loop.actuation").metadata
    assert "findings" not in texts.names


def test_a_campaign_is_found_again_by_its_folder(tmp_path: Path) -> None:
    path = written(tmp_path)
    out = tmp_path / "out"
    open_campaign(out, CampaignPlan.load(path), resume=True).close()
    assert json.loads((out / "campaign.json").read_text()) == {
        "sweep": str(path),
        "identity": CampaignPlan.load(path).identity,
    }
    assert plan_in(out).source == path
    before = blake2b(path.read_bytes(), digest_size=16).hexdigest()
    written(tmp_path, campaign={"seeds": 7})
    now = blake2b(path.read_bytes(), digest_size=16).hexdigest()
    with pytest.raises(BadInput) as caught:
        plan_in(out)
    error = caught.value
    assert (error.source, error.key, error.value) == (str(path), "", f"BLAKE2b {now}")
    assert error.expected == f"BLAKE2b {before}, as other runs of the campaign met it"


def test_a_file_of_the_user_s_in_memory_is_watched() -> None:
    """/dev is of the machine but for this: a bench there was in no campaign's identity."""
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        path = Path(folder) / "load.csv"
        path.write_text("0,0\n")
        with opened_files() as opened:
            path.read_text()
            Path("/dev/null").read_text()
        assert opened.digests == {str(path): digest_of(str(path))}


def test_a_folder_without_a_campaign_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput) as caught:
        plan_in(tmp_path)
    told = f"DIR: found '{tmp_path}', expected the folder of a campaign: --out of hil campaign"
    assert str(caught.value) == told
    (tmp_path / "campaign.json").write_text('{"sweep": 3}')
    with pytest.raises(BadInput) as caught:
        plan_in(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'seal'}: found 'no file', expected a campaign with its")


def test_a_guide_is_a_figure(tmp_path: Path) -> None:
    its = plan(campaign={"seeds": 40}, draw=[INERTIA], adaptive={"guide": "speed", "round_runs": 20})
    with pytest.raises(BadInput) as caught:
        open_campaign(tmp_path / "out", its, resume=False)
    error = caught.value
    assert (error.key, error.value, error.expected) == (
        "adaptive.guide",
        "speed",
        f"one of {', '.join(FIGURES)}",
    )
    assert not (tmp_path / "out").exists()


def test_what_a_killed_campaign_left_half_written_is_no_hindrance(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "campaign.writing").write_text("{")
    with open_campaign(out, plan(vary=[LOSS]), resume=False) as store:
        assert store.count == 0
        store.append([])
    assert list((out / "runs").iterdir()) == []
