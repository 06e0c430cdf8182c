"""Network files: what is read, what is refused, and the network that a run's records show."""

from pathlib import Path

import numpy as np
import pytest

from servobench.drivers.errors import BadInput, BenchError
from servobench.hil.configuration.network_file import ClockHealth, Network, load_network, network_text
from servobench.hil.loop.cycle_record import COMMAND_FATES, FATE_MISSED, NOTHING
from servobench.hil.loop.samples import CommandFate
from servobench.hil.recording.log_files import NetworkKeeper
from servobench.hil.reviewing.network_meter import NetworkMeter
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import AxisPlan, ReviewPlan
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.virtual_bus.faults.fault_plan import read_fault_plan
from tests.unit.hil.test_summary import summary_with, timing

PERIOD_US, PERIOD_NS = 2_000, 2_000_000
LOST = 1


def rows_of(fates: list[int], axis: int = 0, first: int = 0) -> Rows:
    """Cycles with a delay of 500 us to the host and 600 us to the actuator."""
    rows = np.zeros(len(fates), ROW_DTYPE)
    sampled = (first + np.arange(len(fates))) * PERIOD_NS
    rows["axis"], rows["fate"] = axis, fates
    rows["sampled_at"] = sampled
    rows["received_at"] = sampled + 500_000
    rows["delay_ns"] = np.where(rows["fate"] == LOST, NOTHING, 500_000)
    rows["command_handed_at"] = sampled + 550_000
    rows["command_on_bus_at"] = rows["command_acts_after"] = sampled + 580_000
    rows["command_acts_by"] = sampled + 600_000
    rows["certain"] = 1
    rows["command_fate"] = COMMAND_FATES.index(CommandFate.ACTING)
    return rows


def measured(*chunks: Rows, axes: int = 1) -> Network:
    meter = NetworkMeter(PERIOD_US, axes)
    for chunk in chunks:
        meter.add(chunk)
    found = meter.network()
    assert found is not None
    return found


def test_a_file_of_three_keys_is_enough(tmp_path: Path) -> None:
    path = tmp_path / "n.toml"
    path.write_text("[network]\nperiod_us = 10000\nlosses_in_a_row_max = 5\ndelay_max_us = 4000\n")
    found = load_network(path)
    assert (found.losses_max, found.period_s, found.delay_max_s) == (5, 0.01, 0.004)
    assert found.age_max_s == pytest.approx(0.064)


def test_losses_on_both_ways_add_up(tmp_path: Path) -> None:
    path = tmp_path / "n.toml"
    path.write_text(
        "[network]\nperiod_us = 10000\nlosses_in_a_row_max = 3\ndelay_max_us = 0\n"
        "command_losses_in_a_row_max = 2\n"
    )
    assert load_network(path).losses_max == 5


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[network]\nlosses_in_a_row_max = 5\ndelay_max_us = 4000\n", "network.period_us"),
        (
            "[network]\nperiod_us = 1\nlosses_in_a_row_max = -1\ndelay_max_us = 4\n",
            "network.losses_in_a_row_max",
        ),
        ("[network]\nperiod_ms = 1\nlosses_in_a_row_max = 1\ndelay_max_us = 4\n", "network.period_ms"),
        ("[net]\n", "net"),
        (
            "[network]\nperiod_us = 1\nlosses_in_a_row_max = 1\ndelay_max_us = 4\n"
            "[network.histogram]\nedges_us = [0, 1]\ncounts = [1, 2]\n",
            "network.histogram.edges_us",
        ),
        (
            "[network]\nperiod_us = 1\nlosses_in_a_row_max = 1\ndelay_max_us = 4\n"
            "[network.command_histogram]\nedges_us = [0, 1, 2]\ncounts = [1]\n",
            "network.command_histogram.edges_us",
        ),
    ],
)
def test_a_bad_file_names_its_key(tmp_path: Path, text: str, key: str) -> None:
    path = tmp_path / "n.toml"
    path.write_text(text)
    with pytest.raises(BenchError) as caught:
        load_network(path)
    assert key in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_blamed_on_the_option(tmp_path: Path) -> None:
    with pytest.raises(BadInput) as caught:
        load_network(tmp_path / "none.toml")
    assert caught.value.source == "--network"


def test_losses_in_a_row_across_chunks() -> None:
    fates = [0, LOST, LOST, 0, LOST, 0, 0, LOST, LOST, LOST, 0, LOST]
    whole = measured(rows_of(fates))
    assert whole.losses_in_a_row == (2, 1, 1)
    assert (whole.losses_in_a_row_max, whole.lost, whole.cycles) == (3, 7, 12)
    for cut in range(1, len(fates)):
        parts = rows_of(fates[:cut]), rows_of(fates[cut:], first=cut)
        assert measured(*parts) == whole


def test_missed_cycles_are_losses_and_uncertain_rows_are_counted() -> None:
    rows = rows_of([0, FATE_MISSED, 0, LOST])
    rows["certain"] = [1, 1, 0, 1]
    found = measured(rows)
    assert (found.missed, found.lost, found.loss_percent, found.uncertain_percent) == (1, 1, 50.0, 25.0)


def test_the_file_tells_each_axis_clock(tmp_path: Path) -> None:
    review = Review(ReviewPlan((AxisPlan("a", 1.0),)))
    review.add(rows_of([0, 0]))
    keeper = NetworkKeeper(tmp_path, review)
    told = timing(clock_steps=2)
    told["axes"]["b"] = {key: value for key, value in told["axes"]["a"].items() if key != "clock"}
    keeper.finish(summary_with(timing=told))
    clocks = load_network(tmp_path / "network.toml").clocks
    assert clocks["a"] == ClockHealth(drift_ppm=-999.96, drift_error_ppm=1.5, error_us=9.25, steps=2)
    assert clocks["b"] == ClockHealth(error_us=9.25, steps=2)


def test_axes_are_counted_apart() -> None:
    mixed = np.concatenate([rows_of([0, LOST, LOST]), rows_of([LOST, 0, LOST], axis=1)])
    assert measured(mixed, axes=2).losses_in_a_row == (2, 1)


def test_a_reading_that_misses_the_decision_acts_a_cycle_later() -> None:
    rows = rows_of([0, 0, 0])
    assert measured(rows).delay_max_us == 600
    rows["received_at"][1] += 100_000
    rows["delay_ns"][1] += 100_000
    found = measured(rows)
    assert found.delay_max_us == 600 + PERIOD_US
    assert found.reading_delay_us is not None
    assert found.reading_delay_us.max == 600.0


def stamped(rows: Rows) -> Rows:
    """The drive has told when each command began to act: 590 us after the sample, right within 2 us."""
    rows["clock_error_ns"] = 2_000
    rows["command_acts_after"] = rows["sampled_at"] + 588_000
    rows["command_acts_by"] = rows["sampled_at"] + 592_000
    return rows


@pytest.mark.parametrize(("told_by_sync", "delay_max_us"), [(0, 592), (4, 592), (5, 600)])
def test_where_most_commands_were_stamped_the_others_say_nothing_of_the_delay(
    told_by_sync: int, delay_max_us: int
) -> None:
    rows = stamped(rows_of([0, 0, 0, 0]))
    loose = rows_of([0] * told_by_sync, first=4)
    loose["clock_error_ns"] = 2_000
    found = measured(rows, loose[:1], loose[1:])
    assert found.commands_acting == 4 + told_by_sync
    assert found.delay_max_us == delay_max_us


def test_an_axis_without_stamps_counts_with_its_bounds() -> None:
    found = measured(np.concatenate([stamped(rows_of([0, 0, 0])), rows_of([0, 0], axis=1)]), axes=2)
    assert found.delay_max_us == 600


def test_what_is_written_is_read_back_and_can_be_injected_again(tmp_path: Path) -> None:
    found = measured(rows_of([0, LOST, 0, 0]))
    path = tmp_path / "network.toml"
    path.write_text(network_text(found))
    assert load_network(path) == found
    assert found.histogram is not None
    table = {"direction": "drive_to_host", **found.histogram.model_dump(mode="json")}
    plan, errors = read_fault_plan({"measured_delay": [table]}, "test", "")
    assert not errors
    assert plan is not None


def test_nothing_came_so_there_is_no_network() -> None:
    meter = NetworkMeter(PERIOD_US, 1)
    meter.add(rows_of([LOST, LOST]))
    assert meter.network() is None


def test_a_bench_file_is_told_from_a_network_file(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text('[bench]\nname = "b"\n')
    with pytest.raises(BadInput, match=r"a bench file.*network\.toml.*hil run"):
        load_network(path)
