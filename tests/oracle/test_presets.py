"""Each preset beside its own cited figures: a simulated drive with it trips, limits and turns as they say."""

import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from servobench import run
from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.drive_model import DriveModel, load_drive_model
from servobench.hil.configuration.motor_file import LING2012, MotorFile, load_motor
from servobench.hil.configuration.preset_files import FOLDER, KINDS, preset_names, preset_origin
from servobench.hil.studies.motor.sheet import Sheet, motor_text
from servobench.virtual_bus.drive.firmware import Firmware, InnerControl
from servobench.virtual_bus.drive.power_stage import Trip
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.scenario.processes import EXAMPLES

DRIVES, MOTORS = (preset_names(kind) for kind in KINDS)
MOTOR = replace(LING2012.parameters, current_max_a=300.0, viscous_friction_nm_s=0.0)
"""No limit of its own; the power-invariant transform: sqrt(3) A of it are 1 A rms."""
LOCKED = replace(MOTOR, inertia_kg_m2=1e6, resistance_ohm=0.05, inductance_d_h=2e-4, inductance_q_h=2e-4)
"""Hardly turns, takes its current at a low voltage, and returns little of it to the link."""
LAX = {"over_voltage_v": 1e3, "under_voltage_v": 1.0}


def cited(kind: str, name: str) -> dict[str, Any]:
    """The file itself, read by another reader."""
    return tomllib.loads((FOLDER / kind / f"{name}.toml").read_text(encoding="utf-8"))


def leaves(table: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{before}{key}.")
        else:
            yield before + key, value


def simulated(name: str, motor: Any = LOCKED, **tables: Any) -> Firmware:
    like = DriveModel.model_validate({"preset": name, **tables})
    firmware = Firmware(motor, DriveParameters(**(like.parameters | like.rates)))
    firmware.start(Instant(0))
    firmware.control(InnerControl.TORQUE)
    return firmware


def at(firmware: Firmware, time_s: float) -> None:
    firmware.advance_to(Instant(round(time_s * NS_PER_S)))


@pytest.mark.parametrize("kind", KINDS)
def test_each_figure_of_a_preset_has_its_document_or_is_marked_assumed(kind: str) -> None:
    for name in preset_names(kind):
        origin, keys = preset_origin(kind, name), dict(leaves(cited(kind, name)))
        figures = {key for key in keys if not key.startswith("preset.")} - {"motor.name", "motor.transform"}
        assert set(origin.sources) == figures, name
        places = (*origin.documents, "assumed")
        assert all(source.startswith(places) for source in origin.sources.values()), name
        assert all(f"{short}" in " ".join(origin.sources.values()) for short in origin.documents), name
        assert set(origin.tolerance_percent) <= figures, name


@pytest.mark.parametrize("name", DRIVES)
def test_a_drive_trips_at_the_voltages_of_its_sheet(name: str) -> None:
    limits, supply = cited("drives", name)["protection"], cited("drives", name)["supply"]
    for limit_v, step_v, trip in (
        (limits["over_voltage_v"], 0.002, Trip.OVER_VOLTAGE),
        (limits["under_voltage_v"], -0.002, Trip.UNDER_VOLTAGE),
    ):
        firmware = simulated(name, supply={"feeds_back": True, "voltage_v": supply["voltage_v"]})
        at(firmware, 0.01)
        assert firmware.inner.trip == Trip.NONE
        inner, time_s = firmware.inner, 0.01
        inner.source_v = limit_v - 100.0 * step_v
        while inner.trip == Trip.NONE:
            held_v = inner.link_v
            time_s += 0.001
            inner.source_v += step_v if time_s > 0.05 else 0.0
            at(firmware, time_s)
            assert time_s < 5.0
        assert inner.trip == trip
        assert held_v == pytest.approx(limit_v, abs=0.02)


@pytest.mark.parametrize("name", DRIVES)
def test_the_peak_current_flows_for_the_time_of_the_sheet_and_no_larger_one_ever(name: str) -> None:
    overload = cited("drives", name)["protection"]["overload"]
    told = cited("drives", name).get("current_sensor", {}).get("gain_error_a_percent", 0.0)
    scale = math.sqrt(3.0) / (1.0 + told / 100.0)
    firmware = simulated(name)
    inner = firmware.inner
    firmware.demand_torque(LOCKED.torque_max_nm)
    at(firmware, 0.98 * overload["peak_time_s"])
    assert inner.current_q_a == pytest.approx(overload["peak_a_rms"] * scale, rel=2e-3)
    assert inner.warning
    assert not inner.limiting
    assert inner.trip == Trip.NONE
    at(firmware, 1.02 * overload["peak_time_s"])
    assert inner.limiting
    assert inner.trip == (Trip.OVERLOAD if overload["reaction"] == "fault" else Trip.NONE)
    at(firmware, 1.02 * overload["peak_time_s"] + 0.1)
    assert inner.current_q_a == pytest.approx(overload["continuous_a_rms"] * scale, rel=2e-3)


@pytest.mark.parametrize("name", DRIVES)
def test_a_current_beyond_that_of_the_sheet_opens_the_power_stage(name: str) -> None:
    limit_a = cited("drives", name)["protection"]["over_current_a_rms"]
    told = 1.0 + cited("drives", name).get("current_sensor", {}).get("gain_error_a_percent", 0.0) / 100.0
    for share, trip in ((0.99, Trip.NONE), (1.01, Trip.OVER_CURRENT)):
        amperes = share * limit_a * math.sqrt(3.0) / told
        firmware = simulated(name, protection={"overload": None})
        firmware.inner.current_max_a = math.inf
        for step in range(1, 201):
            firmware.demand_torque(LOCKED.torque_constant_nm_a * amperes * told * step / 200.0)
            at(firmware, 0.005 * step)
        assert firmware.inner.trip == trip


@pytest.mark.parametrize("name", DRIVES)
def test_a_motor_turns_as_fast_as_the_share_of_the_supply_lets_it(name: str) -> None:
    tables = cited("drives", name)
    volts = tables["supply"]["voltage_v"] * tables.get("inverter", {}).get("output_percent", 100.0) / 100.0
    motor = replace(MOTOR, inertia_kg_m2=1e-4)
    firmware = simulated(name, motor, protection={"overload": None})
    firmware.limit(10.0, 5.0, math.inf)
    firmware.demand_torque(0.2)
    at(firmware, 3.0)
    reached = motor.pole_pairs * motor.flux_linkage_wb * firmware.speed_rad_s * math.sqrt(2.0)
    assert reached == pytest.approx(volts, rel=0.03)


@pytest.mark.parametrize("name", DRIVES)
def test_current_loops_and_encoder_have_the_rates_of_the_sheet(name: str) -> None:
    tables = cited("drives", name)
    firmware = simulated(name)
    at(firmware, 1.0)
    assert firmware.ticks == pytest.approx(tables["current_loop"]["rate_hz"], abs=1)
    bench = Bench.load(EXAMPLES / "ling2012.toml").changed({"drive.axis1.simulation": {"like": name}})
    simulation = bench.config.drive["axis1"].simulation
    assert simulation.inner_rate_hz == tables["current_loop"]["rate_hz"]
    counts = tables.get("encoder", {}).get("counts_per_revolution", 65536)
    assert simulation.encoder_counts_per_revolution == counts
    own = bench.changed({"drive.axis1.simulation.inner_rate_hz": 16_000})
    assert own.config.drive["axis1"].simulation.inner_rate_hz == 16_000


def test_a_told_torque_that_is_not_made() -> None:
    """iPOS8010: 4 % of the current."""
    firmware = simulated("ipos8010")
    firmware.demand_torque(LOCKED.torque_constant_nm_a * 5.0)
    at(firmware, 0.1)
    inner = firmware.inner
    assert inner.torque_measured_nm / (LOCKED.torque_constant_nm_a * inner.current_q_a) == pytest.approx(1.04)


@pytest.mark.parametrize("name", MOTORS)
def test_a_motor_is_what_its_sheet_says(name: str) -> None:
    tables, sheet = cited("motors", name), preset_origin("motors", name).sheet
    made = MotorFile.model_validate(tomllib.loads(motor_text(Sheet(tables["motor"]["name"], sheet))))
    assert load_motor(Path(name)).tables == made.tables


def test_a_bench_runs_on_presets_and_changes_single_figures_of_them() -> None:
    bench = Bench.load(EXAMPLES / "ling2012.toml").changed(
        {"drive.axis1.simulation.like": "el7211", "drive.axis1.simulation.like.supply.voltage_v": 40.0}
    )
    like = bench.config.drive["axis1"].simulation.like
    assert like is not None
    assert like.supply is not None
    assert (like.supply.voltage_v, like.supply.capacitance_uf) == (40.0, 500.0)
    motor = Bench.load(EXAMPLES / "ling2012.toml").changed({"drive.axis1.motor": "wittenstein-premo-2d"})
    assert motor.config.drive["axis1"].motor.motor.name == "WITTENSTEIN premo 2D"
    mains = bench.changed(
        {"drive.axis1.simulation.like.supply.voltage_v": 300.0, "drive.axis1.simulation.like.protection": LAX}
    )
    assert run(mains).verdict.completed


@pytest.mark.parametrize(("load", "kind"), [(load_drive_model, "drives"), (load_motor, "motors")])
def test_a_wrong_name_is_refused_with_the_list_of_names(load: Any, kind: str) -> None:
    with pytest.raises(BadInput) as caught:
        load(Path("epos5"), NamedBy("bench.toml", "drive.axis1.simulation.like", "epos5"))
    assert caught.value.expected == f"a preset: {', '.join(preset_names(kind))}"
    assert (caught.value.source, caught.value.key) == ("bench.toml", "drive.axis1.simulation.like")


def test_a_wrong_name_and_a_wrong_figure_in_tables_are_refused_by_their_keys() -> None:
    key = "drive.axis1.simulation.like"
    bench = Bench.load(EXAMPLES / "ling2012.toml")
    with pytest.raises(BadInput) as caught:
        _ = bench.changed({key: {"preset": "epos5"}}).config
    assert (caught.value.key, caught.value.value) == (f"{key}.preset", "epos5")
    assert caught.value.expected == f"one of {', '.join(DRIVES)}"
    with pytest.raises(BadInput) as caught:
        _ = bench.changed({key: {"preset": "el7211", "supply": {"voltage_v": -1.0}}}).config
    assert (caught.value.key, caught.value.value) == (f"{key}.supply.voltage_v", -1.0)
