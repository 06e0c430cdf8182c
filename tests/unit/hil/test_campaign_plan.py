"""Sweep files: what they refuse, and which runs they make."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import qmc

from servobench.drivers.errors import BadInput
from servobench.hil.campaign.campaign import Enough
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.statistics import anytime
from servobench.hil.campaign.sweep_file import sweep_from
from servobench.hil.configuration.config_files import BadInputs, toml_text
from servobench.virtual_bus.faults.fault_plan import FaultPlan

LING = Path(__file__).parents[3] / "examples" / "ling2012.toml"
LOSS: dict[str, Any] = {"key": "faults.loss.0.probability", "values": [0.0, 0.1, 0.2]}
GAIN: dict[str, Any] = {
    "key": "drive.axis1.controller.proportional_nm_s_rad",
    "from": 0.05,
    "to": 0.2,
    "count": 3,
}
INERTIA: dict[str, Any] = {
    "key": "drive.axis1.motor.mechanics.inertia_kg_m2",
    "distribution": "log_uniform",
    "low": 0.0004,
    "high": 0.0016,
}


MOTOR = LING.parent / "motors" / "ling2012.toml"
SHAFT = "drive.axis1.simulation.motor"
FITTED: dict[str, tuple[float, float]] = {
    "mechanics.inertia_kg_m2": (8e-4, 1e-5),
    "mechanics.coulomb_friction_nm": (0.02, 0.001),
    "load.hanging_nm": (0.1, 0.01),
    "twin.speed_filter_hz": (500.0, 20.0),
}
"""Value and standard uncertainty of a twin's keys."""


def tables(**more: Any) -> dict[str, Any]:
    campaign = {"name": "try", "bench": str(LING), **more.pop("campaign", {})}
    return {"campaign": campaign, **more}


def plan(**more: Any) -> CampaignPlan:
    return CampaignPlan(sweep_from(tables(**more), "sweep.toml"), Path("sweep.toml"))


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"vary": [{"key": "a.b", "valus": [1]}]}, "vary[0].valus: found [1]"),
        ({"vary": [{"key": "a.b"}]}, "one of: values; rows beside keys; or from, to and count"),
        ({"vary": [{"key": "a.b", "from": 0.0, "to": 1.0}]}, "one of: values"),
        ({"vary": [{"keys": ["a", "b"], "rows": [[1]]}]}, "in each of rows 2 values"),
        ({"vary": [{"key": "a.b", "from": 0.0, "to": 1.0, "count": 3, "spacing": "log"}]}, "above 0"),
        ({"vary": [LOSS, LOSS]}, "each key once"),
        ({"vary": [{"key": "bench.seed", "values": [1]}]}, "campaign.seeds"),
        ({"draw": [{**INERTIA, "mean": 1.0}]}, "low and high for log_uniform"),
        ({"draw": [INERTIA], "drawing": {"method": "sobol"}, "campaign": {"seeds": 10}}, "a power of two"),
        (
            {"drawing": {"method": "sobol"}, "stop": {"rate_width": 0.1}},
            "random: an end when enough was seen",
        ),
        ({"stop": {"rate_width": 2.0}}, "stop.rate_width: found 2.0"),
        ({"campaign": {"bench": "nowhere.toml"}}, "campaign.bench"),
        ({"vary": [{"key": "loop.deadlin_us", "values": [1]}]}, "loop.deadlin_us: found 1"),
        ({"vary": [{"key": "loop.deadline_us", "values": [900, -1]}]}, "loop.deadline_us: found -1"),
        ({"change": {"bus.spec": "hub:x"}}, "bus.spec: found 'hub:x'"),
        ({"campaign": {"seeds": 10_000_000}, "vary": [LOSS]}, "30000000 runs"),
    ],
)
def test_what_cannot_be_is_refused_with_file_key_and_value(more: dict[str, Any], told: str) -> None:
    with pytest.raises((BadInput, BadInputs), match=re.escape(told)):
        plan(**more)


def test_every_point_meets_the_same_draws_and_seeds_each_once() -> None:
    """Two runs at a point with one seed lose the same frames: no interval may count them as two."""
    found = plan(
        campaign={"seeds": 8, "first_seed": 7},
        vary=[LOSS, GAIN],
        draw=[INERTIA],
        drawing={"method": "latin_hypercube"},
    )
    assert (found.points, found.count) == (9, 72)
    runs = [found.run(number) for number in range(found.count)]
    assert [run.number for run in runs] == list(range(72))
    met = [[(r.seed, r.changes[INERTIA["key"]]) for r in runs if r.point == point] for point in range(9)]
    assert all(each == met[0] for each in met)
    assert [seed for seed, _ in met[0]] == list(range(7, 15))
    assert len({value for _, value in met[0]}) == 8
    assert len({(r.changes[LOSS["key"]], r.changes[GAIN["key"]]) for r in runs}) == 9
    assert sorted({r.changes[GAIN["key"]] for r in runs}) == pytest.approx([0.05, 0.125, 0.2])


@pytest.mark.parametrize("method", ["random", "latin_hypercube", "sobol"])
def test_draws_follow_their_distribution(method: str) -> None:
    keys = [
        INERTIA,
        {
            "key": "loop.deadline_us",
            "distribution": "normal",
            "mean": 2000.0,
            "deviation": 50.0,
            "whole": True,
        },
    ]
    found = plan(campaign={"seeds": 256}, draw=keys, drawing={"method": method, "seed": 3})
    drawn = np.array([[run.changes[key["key"]] for key in keys] for run in map(found.run, range(256))])
    even = np.log(drawn[:, 0] / 0.0004) / np.log(4.0)
    assert even.min() >= 0.0
    assert even.max() < 1.0
    counts = np.histogram(even, 256, (0.0, 1.0))[0]
    assert (counts.max() == 1) == (method != "random"), "one in each of its layers"
    assert drawn[:, 1].mean() == pytest.approx(2000.0, abs=10.0)
    assert drawn[:, 1].std() == pytest.approx(50.0, rel=0.15)
    assert (drawn[:, 1] == drawn[:, 1].round()).all()
    if method == "sobol":
        assert qmc.discrepancy(even[:, None]) < 1e-4


def test_choices_may_be_tables_rows_and_files() -> None:
    rows = [[{"kind": "arrival"}, 0.1], [{"kind": "stamp", "delay_us": 3000}, 0.2]]
    plans = {"key": "faults", "values": [{"plan": "faults/jitter.toml"}, {}], "labels": ["jitter", "none"]}
    keys = ["drive.axis1.compensator", "drive.axis1.controller.proportional_nm_s_rad"]
    found = plan(
        change={"loop.actuation": "on_sync", "loop.deadline_us": 3500},
        vary=[
            {"keys": keys, "rows": rows},
            plans,
        ],
    )
    labels = [found.run(number).labels for number in range(4)]
    assert [label["faults"] for label in labels] == ["jitter", "none"] * 2
    assert [label[keys[0]] for label in labels] == ["arrival, 0.1"] * 2 + ["stamp, 0.2"] * 2
    configs = [found.bench.changed(found.run(number).changes).config for number in range(4)]
    assert [config.drive["axis1"].compensator.kind for config in configs] == ["arrival"] * 2 + ["stamp"] * 2
    assert isinstance(configs[0].faults, FaultPlan)
    assert "delay" in configs[0].faults.as_tables()


def test_a_sweep_is_known_again_by_all_that_it_names(tmp_path: Path) -> None:
    bench = tmp_path / "bench.toml"
    motors = LING.parent / "motors" / "ling2012.toml"
    text = (
        LING.read_text()
        .replace("motors/ling2012.toml", "motor.toml")
        .replace('plan = "faults/demo.toml"', "")
    )
    bench.write_text(text)
    motor = tmp_path / "motor.toml"
    motor.write_text(motors.read_text())

    def identity() -> Any:
        return plan(campaign={"bench": str(bench)}).identity

    before = identity()
    assert identity() == before
    motor.write_text(motors.read_text().replace("inertia_kg_m2 = 0.0008", "inertia_kg_m2 = 0.0009"))
    assert identity() != before


def test_the_stopping_rule_ends_between_replicates_when_each_point_is_known() -> None:
    found = plan(campaign={"seeds": 10_000}, vary=[LOSS], stop={"rate_width": 0.2})
    enough = Enough(found)
    passes = {0: 1.0, 1: 0.9, 2: 0.5}
    stream = np.random.default_rng(1)
    count = [0, 0, 0]
    for number in range(found.count):
        point = number % 3
        passed = bool(stream.random() < passes[point])
        count[point] += passed
        if enough({"run": number, "point": point, "passed": passed}):
            break
    replicates = (number + 1) // 3
    assert (number + 1) % 3 == 0
    widths = [anytime(each, replicates, 0.95).width for each in count]
    assert max(widths) <= 0.2
    assert 250 < replicates < 350, "a planned number of 96 would have that width, and lie to who looks"


@pytest.mark.parametrize("name", sorted(path.name for path in (LING.parent / "campaigns").iterdir()))
def test_the_examples_can_be_run(name: str) -> None:
    found = CampaignPlan.load(LING.parent / "campaigns" / name)
    assert found.count >= 150
    assert found.bench.changed(found.run(found.known - 1).changes).config.axes == ("axis1",)


def written_twin(folder: Path, together: float) -> Path:
    """Write a twin whose inertia and weight are correlated by ``together``."""
    apart = np.array([uncertainty for _, uncertainty in FITTED.values()])
    shares = np.eye(len(apart))
    shares[0, 2] = shares[2, 0] = together
    keys = [
        {"name": name, "value": value, "uncertainty": 2.0 * uncertainty, "source": "fitted"}
        for name, (value, uncertainty) in FITTED.items()
    ]
    viscous = {"name": "mechanics.viscous_friction_nm_s", "value": 0.0001, "source": "not determined"}
    twin = {
        "structure": "rigid",
        "dead_time_us": 100.0,
        "speed_filter_hz": 500.0,
        "torque_unit_nm": 0.001,
        "window_s": 0.2,
        "speed_rpm": [-1000.0, 1000.0],
        "torque_nm": [-1.0, 1.0],
        "band_hz": [1.0, 100.0],
        "left": [0.1, 0.001, 0.001],
        "left_bands": [0.01],
        "covariance": (shares * np.outer(apart, apart)).tolist(),
        "key": [viscous, *keys],
        "recording": [{"digest": "0", "bench": "one", "windows": 50, "left_out": 0}],
    }
    path = folder / "twin.toml"
    path.write_text(MOTOR.read_text("utf-8") + "\n" + toml_text({"twin": twin}), "utf-8")
    return path


def test_members_of_a_twin_have_its_means_and_its_covariance(tmp_path: Path) -> None:
    path = written_twin(tmp_path, 0.8)
    drawing = {"method": "sobol", "seed": 3}
    made = plan(
        draw=[INERTIA],
        twin=[{"key": SHAFT, "file": str(path)}],
        drawing=drawing,
        campaign={"seeds": 1024},
    )
    names = list(FITTED)[:3]
    runs = [made.run(number) for number in range(1024)]
    values = np.array([[each.labels[f"{SHAFT}.{name}"] for name in names] for each in runs])
    means, apart = (np.array(column) for column in zip(*(FITTED[name] for name in names), strict=True))
    assert values.mean(axis=0) == pytest.approx(means, abs=float(0.01 * apart.max()), rel=1e-3)
    assert values.std(axis=0) == pytest.approx(apart, rel=0.02)
    assert np.corrcoef(values.T) == pytest.approx(np.array([[1, 0, 0.8], [0, 1, 0], [0.8, 0, 1]]), abs=0.03)
    motors = [made.bench.changed(each.changes).config.drive["axis1"].simulation.motor for each in runs[:3]]
    for motor, row in zip(motors, values, strict=False):
        assert motor is not None
        assert motor.load is not None
        assert (motor.mechanics.inertia_kg_m2, motor.load.hanging_nm) == (row[0], row[2])
        assert motor.mechanics.coulomb_friction_nm == row[1]
    assert "twin.speed_filter_hz" not in " ".join(runs[0].labels)


@pytest.mark.parametrize("key", [SHAFT, INERTIA["key"]])
def test_a_motor_without_a_fit_has_no_members_and_a_key_is_drawn_once(key: str, tmp_path: Path) -> None:
    twin = MOTOR if key == SHAFT else written_twin(tmp_path, 0.0)
    with pytest.raises(BadInput, match="a twin of hil fit" if key == SHAFT else "each key once"):
        plan(draw=[INERTIA], twin=[{"key": key, "file": str(twin)}])
    with pytest.raises(BadInput, match="a motor of which nothing else is set"):
        plan(draw=[INERTIA], twin=[{"key": "drive.axis1.motor", "file": str(twin)}])
