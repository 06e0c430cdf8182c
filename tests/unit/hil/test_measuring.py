"""The parts of a measurement: set-points, whose change is whose, what became of the frames of each cycle."""

import math
from pathlib import Path

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.exchange import SentCommand
from servobench.drivers.record import replaced
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.configuration.network_file import load_network, network_text
from servobench.hil.loop.cycle_record import COMMAND_FATES, NOTHING
from servobench.hil.loop.samples import AT_REST, CommandFate
from servobench.hil.measuring.figures import network_of
from servobench.hil.measuring.loss_model import CAME, LOST, UNKNOWN
from servobench.hil.measuring.stages import (
    Stage,
    TimedDemandChange,
    acting,
    command_stages,
    host_stages,
    reading_stages,
    refined,
    ways,
)
from servobench.hil.measuring.subject import Excitation, steps_of
from servobench.hil.rows.records import ROW_DTYPE, Rows
from tests.unit.hil.cycles import advance, torque_of

PERIOD_NS = 1_000_000
UNIT_NM = 0.002
ON_BUS_NS, HANDED_NS = 330_000, 250_000
LOST_FATE, MISSED_FATE = 1, 4


def torques(steps: int, cycles: int, speed_rad_s: float = 0.0) -> list[float]:
    excitation = Excitation(steps, UNIT_NM, 10.0, seed=3)
    estimate = replaced(AT_REST, velocity_rad_s=speed_rad_s)
    found = []
    for _ in range(cycles):
        torque_nm = torque_of(excitation, estimate)
        assert torque_nm == torque_of(excitation, estimate), "nothing changes before the update"
        advance(excitation, estimate, torque_nm)
        found.append(torque_nm)
    return found


@pytest.mark.parametrize("steps", [8, 30])
def test_no_set_point_comes_twice_among_as_many_as_half_the_steps(steps: int) -> None:
    found = [abs(round(torque / UNIT_NM)) for torque in torques(steps, 500)]
    assert set(found) == set(range(1, steps + 1))
    for place in range(len(found)):
        window = found[place : place + steps // 2 + 1]
        assert len(set(window)) == len(window)


def test_torques_alternate_and_sum_to_little() -> None:
    found = np.array(torques(30, 1000))
    assert (np.diff(np.sign(found)) != 0).all()
    assert abs(found.mean()) < 2.0 * UNIT_NM


@pytest.mark.parametrize("speed_rad_s", [4.0, -4.0])
def test_a_shaft_that_has_wandered_off_is_braked(speed_rad_s: float) -> None:
    assert {math.copysign(1.0, torque) for torque in torques(30, 20, speed_rad_s)} == {-np.sign(speed_rad_s)}


def test_the_bound_is_counted_in_the_drive_s_steps() -> None:
    assert steps_of(None, 2.0) == 30
    assert steps_of(0.02, 2.0) == 10
    assert steps_of(2.0, 2.0) == 1000
    for torque_nm in (0.015, 2.01, 0.0, -1.0):
        with pytest.raises(BadInput, match=r"from 0\.016 N m, 8 steps .* rated 2 N m"):
            steps_of(torque_nm, 2.0)


def sent(cycle: int, raw: int, *, on_bus: bool = True) -> SentCommand:
    command = SentCommand(cycle, raw, Instant(cycle * PERIOD_NS + HANDED_NS))
    command.on_bus_at = Instant(cycle * PERIOD_NS + ON_BUS_NS) if on_bus else None
    return command


def change(raw: int, at_ns: float, error_ns: int = 1000) -> TimedDemandChange:
    return TimedDemandChange(raw, Instant(round(at_ns)), error_ns)


def test_a_change_is_that_of_the_newest_command_of_its_value() -> None:
    commands = [sent(1, 5), sent(2, -7), sent(3, 9), sent(4, 5)]
    told = [change(5, 1.4e6), change(-7, 2.4e6), change(5, 4.9e6)]
    found = acting(commands, told)
    assert found == {1: told[0], 2: told[1], 4: told[2]}, "nothing tells of the third"


def test_a_stamp_is_rounded_down_and_a_value_told_twice_counts_once() -> None:
    commands = [sent(1, 5), sent(9, 5)]
    first, again = change(5, 1e6 + ON_BUS_NS - 900), change(5, 3e6)
    assert acting(commands, [first, again]) == {1: first}
    assert acting(commands, [change(5, 0.5e6), change(77, 2e6)]) == {}, "before it, or of nobody's value"


def rows_of(cycles: int) -> Rows:
    """All is well: SYNC after 50 us, reading after 120 us more, command acting by the next SYNC."""
    rows = np.zeros(cycles, ROW_DTYPE)
    due = np.arange(1, cycles + 1) * PERIOD_NS
    rows["sequence"] = np.arange(1, cycles + 1)
    rows["due_at"] = rows["woke_at"] = rows["sync_handed_at"] = due
    rows["sync_on_bus_at"] = rows["sampled_at"] = due + 50_000
    rows["received_at"], rows["delay_ns"], rows["certain"] = due + 170_000, 120_000, 1
    rows["device_time_ns"] = due
    rows["command_handed_at"], rows["command_on_bus_at"] = due + HANDED_NS, due + ON_BUS_NS
    rows["command_fate"] = COMMAND_FATES.index(CommandFate.ACTING)
    rows["command_acts_after"], rows["command_acts_by"] = due + ON_BUS_NS, due + PERIOD_NS + 50_000
    return rows


def test_each_way_has_its_own_losses() -> None:
    rows = rows_of(6)
    rows["fate"][1] = LOST_FATE
    rows["fate"][2] = LOST_FATE
    rows["sync_on_bus_at"][2] = NOTHING
    rows["fate"][3] = MISSED_FATE
    for key in ("sync_handed_at", "sync_on_bus_at", "command_handed_at", "command_on_bus_at", "command_fate"):
        rows[key][3] = NOTHING
    rows["command_on_bus_at"][4] = NOTHING
    rows["command_fate"][4] = rows["command_fate"][5] = COMMAND_FATES.index(CommandFate.LOST)
    found = ways(rows, EchoBasis.BUS, acting=True)
    assert {way: outcomes.tolist() for way, outcomes in found.items()} == {
        "sync_before_bus": [CAME, CAME, LOST, UNKNOWN, CAME, CAME],
        "reading": [CAME, LOST, UNKNOWN, UNKNOWN, CAME, CAME],
        "command_before_bus": [CAME, CAME, CAME, UNKNOWN, LOST, CAME],
        "command_behind_bus": [CAME, CAME, CAME, UNKNOWN, UNKNOWN, LOST],
        "readings": [CAME, LOST, LOST, UNKNOWN, CAME, CAME],
        "commands": [CAME, CAME, CAME, UNKNOWN, LOST, LOST],
    }
    disabled = ways(rows, EchoBasis.NONE, acting=False)
    for way in ("sync_before_bus", "command_before_bus", "command_behind_bus", "commands"):
        assert set(disabled[way].tolist()) == {UNKNOWN}
    assert disabled["reading"].tolist() == disabled["readings"].tolist() == found["readings"].tolist()


def test_what_is_known_better_takes_the_bracket_s_place() -> None:
    rows = rows_of(3)
    rows["command_fate"][1] = COMMAND_FATES.index(CommandFate.LOST)
    rows["command_fate"][2] = COMMAND_FATES.index(CommandFate.NOT_IDENTIFIABLE)
    rows["command_acts_after"][2] = NOTHING
    changes = {cycle: change(cycle, cycle * PERIOD_NS + 500_000, 1_500) for cycle in (1, 2, 3)}
    better = refined(rows, changes, [sent(cycle, cycle) for cycle in (1, 2, 3)])
    fates = [COMMAND_FATES[fate] for fate in better["command_fate"]]
    assert fates == [CommandFate.ACTING, CommandFate.ACTING, CommandFate.NOT_IDENTIFIABLE]
    assert better["command_acts_after"][:2].tolist() == [1_498_500, 2_498_500]
    assert better["command_acts_by"][:2].tolist() == [1_501_500, 2_501_500]
    assert rows["command_fate"][1] == COMMAND_FATES.index(CommandFate.LOST), "the rows themselves are left"


def largest_us(stages: list[Stage], key: str) -> float | None:
    times = next(stage.times for stage in stages if stage.key == key)
    return None if times.largest_ns is None else times.largest_ns / 1e3


def test_the_stages_are_those_of_the_rows() -> None:
    rows = rows_of(5)
    rows["woke_at"][2] += 80_000
    rows["sampled_at"][3] += 30_000
    rows["delay_ns"][4] = 140_000
    found = [
        *host_stages(rows, EchoBasis.KERNEL),
        *reading_stages(rows, [7_000]),
        *command_stages(rows, [sent(1, 1)], {}, [9_000], EchoBasis.KERNEL, "why not"),
    ]
    largest = {stage.key: largest_us(found, stage.key) for stage in found}
    assert largest == {
        "wake_up": 80.0,
        "sync_on_bus": 50.0,
        "sample": 30.0,
        "reception": 140.0,
        "to_user_code": 7.0,
        "computation": 9.0,
        "command_on_bus": 80.0,
        "command_acting_least": 0.0,
        "command_acting": 720.0,
        "sample_to_acting": 1000.0,
    }


def test_without_echoes_the_way_to_the_bus_is_not_measured() -> None:
    rows = rows_of(5)
    (_, sync) = host_stages(rows, EchoBasis.NONE)
    assert not sync.measured
    assert "no echo" in sync.basis


def test_the_network_of_several_drives_says_how_sure_it_is(tmp_path: Path) -> None:
    both = [rows_of(1000), rows_of(1000)]
    both[1]["axis"] = 1
    both[1]["fate"][::10] = LOST_FATE
    found = network_of(1000, both, [ways(rows, EchoBasis.BUS, acting=True) for rows in both])
    assert found is not None
    assert found.loss_percent == pytest.approx(5.0)
    assert found.certainty is not None
    low, high = found.certainty.loss_percent
    assert low < 5.0 < high
    assert found.certainty.reading_delay_share == pytest.approx(1.0 - 3.0 / 1900, rel=1e-3)
    assert found.certainty.action_delay_share == pytest.approx(1.0 - 3.0 / 2000, rel=1e-3)
    assert found.command_losses is None, "none was lost: there is nothing to model"
    assert found.command_histogram is not None
    path = tmp_path / "network.toml"
    path.write_text(network_text(found), encoding="utf-8")
    assert load_network(path) == found
