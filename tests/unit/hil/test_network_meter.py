"""The network of a run counted by hand, losses in a row by brute force, delays by the definition of each."""

from itertools import groupby

import numpy as np
import pytest

from servobench.hil.configuration.network_file import ClockHealth, DelayFigures, DelayHistogram, Network
from servobench.hil.loop.cycle_record import CAUSES, COMMAND_FATES, NOTHING
from servobench.hil.loop.samples import CommandFate, DropoutCause
from servobench.hil.reviewing.histogram import TimeHistogram
from servobench.hil.reviewing.network_meter import (
    STAMPED_WITHIN,
    LossRuns,
    NetworkMeter,
    action_delays_ns,
    clocks_of,
    delays_of,
    histogram_of,
    runs_of,
)
from servobench.hil.rows.records import ROW_DTYPE, Rows
from tests.unit.hil.test_summary import summary_with, timing

US = 1_000
PERIOD_US, PERIOD_NS = 1_000, 1_000_000
ACTING, LOST, UNKNOWN, UNMEASURED = (
    COMMAND_FATES.index(fate)
    for fate in (
        CommandFate.ACTING, CommandFate.LOST, CommandFate.NOT_IDENTIFIABLE, CommandFate.NOT_MEASURED
    )
)  # fmt: skip
SAMPLE = 0
GONE, LATE, STALE, MISSED = (
    1 + CAUSES.index(cause)
    for cause in (DropoutCause.LOST, DropoutCause.LATE, DropoutCause.STALE, DropoutCause.MISSED)
)


def rows(*fates: tuple[int, int], axis: int = 0) -> Rows:
    """One each cycle, by the fates of reading and command.

    The reading comes 100 us after its sample, the command leaves 200 us after it, is on the bus at 230 us,
    and acts from 700 to 900 us.
    """
    made = np.zeros(len(fates), ROW_DTYPE)
    made["sequence"] = np.arange(1, len(fates) + 1)
    sampled = 7_000_000_000 + np.arange(len(fates)) * PERIOD_NS
    made["axis"], made["certain"], made["sampled_at"] = axis, 1, sampled
    for name, after_us in (
        ("received_at", 100),
        ("command_handed_at", 200),
        ("command_on_bus_at", 230),
        ("command_acts_after", 700),
        ("command_acts_by", 900),
    ):
        made[name] = sampled + after_us * US
    made["fate"] = [fate for fate, _ in fates]
    came = np.isin(made["fate"], [SAMPLE, LATE, STALE])
    made["delay_ns"] = np.where(came, 100 * US, NOTHING)
    made["command_fate"] = [fate for _, fate in fates]
    for name in ("command_acts_after", "command_acts_by"):
        made[name][made["command_fate"] != ACTING] = NOTHING
    return made


def network(*chunks: Rows, axes: int = 1) -> Network:
    meter = NetworkMeter(PERIOD_US, axes)
    for chunk in chunks:
        meter.add(chunk)
    measured = meter.network()
    assert measured is not None
    return measured


def always(delay_us: float) -> DelayFigures:
    return DelayFigures(p50=delay_us, p99=delay_us, p999=delay_us, max=delay_us)


def test_a_run_counted_by_hand() -> None:
    run = rows(
        (SAMPLE, ACTING), (GONE, ACTING), (LATE, LOST), (SAMPLE, UNKNOWN), (STALE, LOST), (SAMPLE, ACTING),
        (MISSED, NOTHING), (GONE, UNMEASURED), (SAMPLE, LOST), (SAMPLE, ACTING),
    )  # fmt: skip
    run["certain"][[1, 4, 8]] = 0
    run["command_on_bus_at"][6] = run["command_handed_at"][6] = NOTHING
    run["delay_ns"][9] += 150 * US
    run["received_at"][9] += 150 * US  # after the decision of its cycle
    expected = Network(
        period_us=1000,
        losses_in_a_row_max=2,
        delay_max_us=1900,
        command_losses_in_a_row_max=2,
        commands="measured",
        cycles=10,
        lost=2,
        late=1,
        stale=1,
        missed=1,
        uncertain_percent=30.0,
        loss_percent=50.0,
        losses_in_a_row=(1, 2),
        reading_delay_us=DelayFigures(p50=100.03, p99=250.0, p999=250.0, max=250.0),
        action_delay_us=DelayFigures(p50=900.0, p99=1900.0, p999=1900.0, max=1900.0),
        action_delay_least_us=DelayFigures(p50=700.0, p99=1700.0, p999=1700.0, max=1700.0),
        command_delay_us=always(30.0),
        commands_acting=4,
        commands_lost=3,
        commands_not_identifiable=1,
        command_loss_percent=300 / 7,
        command_loss_least_percent=300 / 7,
        histogram=DelayHistogram(
            edges_us=tuple(3.0 * edge for edge in range(33, 85)), counts=(6, *[0] * 49, 1)
        ),
    )
    measured = network(run)
    figures = ("reading_delay_us", "action_delay_us", "action_delay_least_us")
    exact = [name for name in Network.model_fields if name not in figures]
    assert {name: getattr(measured, name) for name in exact} == {
        name: getattr(expected, name) for name in exact
    }
    for name in figures:  # a histogram is right within a thousandth
        assert getattr(measured, name).model_dump() == pytest.approx(
            getattr(expected, name).model_dump(), rel=1e-3
        )
    for cut in range(11):
        assert network(run[:cut], run[cut:]) == measured


def test_without_a_command_that_acts_the_largest_delay_is_that_of_the_readings() -> None:
    run = rows((SAMPLE, UNMEASURED), (SAMPLE, NOTHING))
    run["command_on_bus_at"] = NOTHING
    run["received_at"][1] += 1
    run["delay_ns"][1] += 1
    measured = network(run)
    assert (measured.commands, measured.delay_max_us, measured.action_delay_us) == ("not measured", 101, None)
    assert (measured.action_delay_least_us, measured.command_delay_us) == (None, None)
    assert (measured.command_loss_percent, measured.commands_acting, measured.commands_lost) == (None, 0, 0)
    assert measured.command_losses_in_a_row_max == 0


def test_commands_lost_in_a_row_are_those_of_which_it_is_known() -> None:
    """What is not identifiable stands between no two of them; each axis counts alone."""
    left = rows((SAMPLE, LOST), (SAMPLE, UNKNOWN), (SAMPLE, LOST), (SAMPLE, ACTING), (SAMPLE, LOST))
    right = rows((SAMPLE, LOST), (SAMPLE, NOTHING), (GONE, LOST), (SAMPLE, LOST), axis=1)
    both = network(left, right, axes=2)
    assert (both.command_losses_in_a_row_max, both.commands_lost, both.command_loss_percent) == (
        3,
        6,
        600 / 7,
    )
    assert (both.losses_in_a_row, both.cycles, both.loss_percent) == ((1,), 9, 100 / 9)


def test_commands_passed_over_count_as_the_most_that_were_lost() -> None:
    run = rows((SAMPLE, ACTING), (SAMPLE, LOST), (SAMPLE, UNKNOWN), (SAMPLE, UNKNOWN), (SAMPLE, ACTING))
    run["command_acts_after"][2] = run["sampled_at"][2] + PERIOD_NS
    found = network(run)
    assert (found.commands_lost, found.commands_passed_over, found.commands_not_identifiable) == (1, 1, 2)
    assert (found.command_loss_least_percent, found.command_loss_percent) == (25.0, 50.0)
    assert found.command_losses_in_a_row_max == 2


def test_no_rows_are_no_network_and_change_none() -> None:
    meter = NetworkMeter(PERIOD_US, 1)
    meter.add(np.zeros(0, ROW_DTYPE))
    assert meter.network() is None
    run = rows((SAMPLE, ACTING), (GONE, ACTING))
    assert network(run, np.zeros(0, ROW_DTYPE)) == network(run)


@pytest.mark.parametrize(
    ("error_ns", "width_ns", "known"),
    [
        (2_000, STAMPED_WITHIN * 2_000, True),
        (2_000, STAMPED_WITHIN * 2_000 + 1, False),
        (0, 0, True),
        (0, 1, False),
        (NOTHING, 0, True),
        (NOTHING, 1, False),
    ],
)
def test_a_command_is_stamped_where_its_bounds_are_no_wider_than_errors_of_the_clock(
    error_ns: int, width_ns: int, known: bool
) -> None:
    """The other one of two acts 900 us after its sample at the latest, and has no stamp."""
    run = rows((SAMPLE, ACTING), (SAMPLE, ACTING))
    run["clock_error_ns"] = error_ns
    run["command_acts_after"][0] = run["sampled_at"][0] + 500 * US
    run["command_acts_by"][0] = run["command_acts_after"][0] + width_ns
    measured = network(run)
    least, most = measured.action_delay_least_us, measured.action_delay_us
    assert least is not None
    assert most is not None
    by_stamp = (500.0, pytest.approx(500.0 + width_ns / 1000.0))
    assert (least.max, most.max) == (by_stamp if known else (700.0, 900.0))


@pytest.mark.parametrize(
    ("late_ns", "periods"),
    [(-1, 0), (0, 0), (1, 1), (PERIOD_NS, 1), (PERIOD_NS + 1, 2), (3 * PERIOD_NS, 3)],
)
def test_a_reading_after_the_decision_acts_as_many_cycles_later(late_ns: int, periods: int) -> None:
    run = rows((SAMPLE, ACTING), (SAMPLE, LOST), (SAMPLE, UNKNOWN))
    run["received_at"] = run["command_handed_at"] + late_ns
    least, most = action_delays_ns(run, PERIOD_NS)
    assert (least.tolist(), most.tolist()) == (
        [700 * US + periods * PERIOD_NS], [900 * US + periods * PERIOD_NS]
    )  # fmt: skip


# ---- losses in a row ----------------------------------------------------------------------------------


def brute(lost: list[bool]) -> tuple[int, ...]:
    lengths = [len(list(group)) for gone, group in groupby(lost) if gone]
    return tuple(lengths.count(length) for length in range(1, max(lengths, default=0) + 1))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("size", [1, 2, 3, 30])
def test_losses_in_a_row_by_brute_force(share: float, size: int) -> None:
    random = np.random.Generator(np.random.PCG64(size))
    for _ in range(20):
        lost = random.random(size) < share
        pieces = np.split(lost, sorted(random.integers(0, size + 1, 3).tolist()))
        counted, first = LossRuns(), 0
        for piece in pieces:
            counted.add(piece, np.arange(first, first + piece.size))
            first += piece.size
        lengths = brute(lost.tolist())
        assert tuple(np.trim_zeros(counted.counts()[1:], "b").tolist()) == runs_of(lost) == lengths
        assert counted.most == len(lengths)
        if counted.at is None:
            assert not lost.any()
        else:
            assert lost[counted.at - counted.most + 1 : counted.at + 1].all()


def test_runs_of_two_axes_do_not_join() -> None:
    first, second = rows((GONE, ACTING), (SAMPLE, ACTING)), rows((GONE, ACTING), (GONE, ACTING), axis=1)
    assert network(first[1:], first[:1], second, axes=2).losses_in_a_row == (1, 1)


@pytest.mark.parametrize("length", [999, 1000, 1001, 5000])
@pytest.mark.parametrize("ends", [False, True])
def test_more_than_a_thousand_in_a_row_count_as_so_many(length: int, ends: bool) -> None:
    counted = LossRuns()
    counted.add(np.array([True] * length + [False] * ends), np.arange(length + ends))
    assert np.flatnonzero(counted.counts()).tolist() == [min(length, 1000)]
    assert (counted.most, counted.at) == (length, length - 1)


# ---- figures ------------------------------------------------------------------------------------------


def histogram(*times_ns: int) -> TimeHistogram:
    times = TimeHistogram()
    times.add(np.array(times_ns, np.int64))
    return times


def test_quantiles_are_by_nearest_rank_in_us() -> None:
    """Below 2048 ns a histogram is exact; the times here are 1 to 2000 ns."""
    figures = delays_of(histogram(*range(1, 2001)))
    assert figures == DelayFigures(p50=1.0, p99=1.98, p999=1.998, max=2.0)
    assert delays_of(histogram(0)) == always(0.0)
    assert delays_of(TimeHistogram()) is None


def test_bars_go_from_the_first_that_is_filled_to_the_last() -> None:
    whole = histogram(5_000, 5_999, 6_000, 8_500, 100_000)
    bars = histogram_of(whole)
    assert bars is not None
    assert bars.edges_us == tuple(map(float, range(5, 101)))
    assert bars.counts == (2, 1, 0, 1, *[0] * 90, 1)
    assert histogram_of(histogram(0, 999)) == DelayHistogram(edges_us=(0.0, 1.0), counts=(2,))
    assert histogram_of(TimeHistogram()) is None


@pytest.mark.parametrize(("largest_us", "width"), [(1, 1), (100, 1), (101, 2), (200, 2), (201, 3)])
def test_a_hundred_bars_reach_to_the_largest_delay(largest_us: int, width: int) -> None:
    bars = histogram_of(histogram(0, largest_us * US))
    assert bars is not None
    assert bars.edges_us[:2] == (0.0, float(width))
    assert (bars.counts[0], sum(bars.counts)) == (1, 2)
    assert len(bars.counts) <= 100


def test_clocks_are_those_of_the_timing() -> None:
    told = timing(clock_steps=3, error_us_max=4.5)
    told["axes"]["b"] = {"error_us_max": 65.0, "clock_steps": 0}
    assert clocks_of(summary_with(timing=told)) == {
        "a": ClockHealth(drift_ppm=-999.96, drift_error_ppm=1.5, error_us=4.5, steps=3),
        "b": ClockHealth(drift_ppm=None, drift_error_ppm=None, error_us=65.0, steps=0),
    }
    assert clocks_of(summary_with(timing=None)) == {}
