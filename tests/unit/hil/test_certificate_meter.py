"""What is seen of a certified loop, beside its certificate."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration
from servobench.hil.loop.cycle_record import COMMAND_FATES
from servobench.hil.loop.samples import CommandFate
from servobench.hil.reviewing.certificate_meter import CertificateMeter
from servobench.hil.reviewing.network_meter import AxisNetworkMeter
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import AxisPlan, CertifiedPlan, ReviewPlan
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.plain_values import from_plain
from servobench.hil.verdict.summary_text import certificate_lines
from tests.unit.hil.row_tools import plain_rows

SETTLING = Duration(100 * NS_PER_MS)
REFERENCE_RAD_S = 100.0
STEP_AT, COUNT = 500, 2_000
CERTIFIED = CertifiedPlan(
    period_us=1_000,
    delay_us=800.0,
    losses_together=2,
    gain=17.0,
    bandwidths_hz=(504.0, 1269.0),
    bandwidth_hz=800.0,
)

AXIS = AxisPlan("axis1", 1e4, certified=CERTIFIED, torque_max_nm=5.0)


def loaded(gain: float, torque_nm: float = 0.5, offset_rad_s: float = 3.0) -> Rows:
    """A load step whose error rises with 20 ms to ``gain`` times it, on top of one that is always there."""
    since_s = 1e-3 * np.arange(COUNT - STEP_AT)
    error = np.full(COUNT, offset_rad_s)
    error[STEP_AT:] += gain * torque_nm * (1.0 - np.exp(-since_s / 0.02))
    load = np.zeros(COUNT)
    load[STEP_AT:] = torque_nm
    return plain_rows(COUNT, REFERENCE_RAD_S, REFERENCE_RAD_S - error, load)


def meter_of(*chunks: Rows, axis: AxisPlan = AXIS) -> CertificateMeter:
    network = AxisNetworkMeter(1_000)
    meter = CertificateMeter(axis, SETTLING, network)
    for chunk in chunks:
        network.add(chunk)
        meter.add(chunk)
    return meter


@pytest.mark.parametrize("torque_nm", [0.5, -0.3])
def test_the_gain_seen_is_that_of_a_first_order_loop_from_below(torque_nm: float) -> None:
    """The rms over the whole stretch comes close to the static gain, and never above it."""
    seen = meter_of(loaded(12.0, torque_nm)).gain_seen
    assert seen is not None
    assert 0.97 * 12.0 < seen < 12.0


def test_a_peak_that_decays_counts_by_the_time_for_which_it_lasted() -> None:
    rows = loaded(0.0)
    rows["velocity_rad_s"][STEP_AT : STEP_AT + 30] -= 6.0
    seen = meter_of(rows).gain_seen
    assert seen == pytest.approx(12.0), "rms of 6 rad/s over 30 ms for 0.5 N m"


def test_a_load_that_sets_in_slowly_makes_no_gain_of_the_noise() -> None:
    """As one from a file does: its first step is a millionth of the rated torque, and the noise goes on."""
    noise = np.random.default_rng(5).normal(0.0, 0.05, COUNT)
    load = np.interp(np.arange(COUNT), [STEP_AT, STEP_AT + 1_000], [0.0, 1e-3])
    rows = plain_rows(COUNT, REFERENCE_RAD_S, REFERENCE_RAD_S - 3.0 - noise, load)
    meter = meter_of(rows, axis=replace(AXIS, rated_torque_nm=1.0))
    assert meter.gain_least is None


def test_without_a_steady_run_before_the_step_nothing_is_seen() -> None:
    rows = loaded(12.0)
    moving = rows.copy()
    moving["reference_rad_s"][:STEP_AT] = 50.0
    assert meter_of(moving).gain_seen is None, "the reference changes with the load"
    assert meter_of(rows[STEP_AT - 50 :]).gain_seen is None, "it had not settled"
    assert meter_of(loaded(12.0, 0.0)).gain_seen is None, "no step"


@pytest.mark.long
def test_the_figures_do_not_depend_on_the_chunks() -> None:
    rows = loaded(12.0)
    rows["velocity_rad_s"] += np.random.default_rng(1).normal(0.0, 0.1, COUNT)
    whole = meter_of(rows).figures()
    for size in (1, 33, 499, 501):
        assert meter_of(*(rows[at : at + size] for at in range(0, COUNT, size))).figures() == whole


def test_a_gain_above_the_certified_one_is_an_event_once() -> None:
    review = Review(ReviewPlan((AxisPlan("axis1", 1e4, certified=CERTIFIED),), settling=SETTLING))
    review.add(loaded(16.9))
    assert review.take_events() == []
    rows = loaded(18.0)
    rows["due_at"] += COUNT * NS_PER_MS
    review.add(rows)
    (event,) = review.take_events()
    assert event.level == "WARN"
    assert "certified 17" in event.text
    assert review.figures().certificates["axis1"]["gain_rad_s_nm"]["certified"] == 17.0


def exact(rows: Rows, delay_us: int = 500, error_us: int = 0) -> Rows:
    """The same with every command acting so long after its sample, told to ``error_us``."""
    rows["sampled_at"] = rows["due_at"]
    rows["received_at"] = rows["due_at"] + 300 * NS_PER_US
    rows["command_handed_at"] = rows["due_at"] + 400 * NS_PER_US
    rows["command_acts_after"] = rows["due_at"] + delay_us * NS_PER_US
    rows["command_acts_by"] = rows["command_acts_after"] + error_us * NS_PER_US
    rows["command_fate"] = COMMAND_FATES.index(CommandFate.ACTING)
    rows["clock_error_ns"] = 2 * NS_PER_US
    return rows


def state_of(rows: Rows, axis: AxisPlan = AXIS) -> tuple[str, str]:
    found = meter_of(*[rows[at : at + 333] for at in range(0, COUNT, 333)], axis=axis).figures()
    return found["state"], "; ".join([*found["premises_left"], *found["premises_unknown"]])


def test_a_certificate_is_kept_or_exceeded_within_its_premises_alone() -> None:
    assert state_of(exact(loaded(17.0))) == ("kept", "")
    assert state_of(exact(loaded(18.0))) == ("exceeded", "")
    assert state_of(exact(loaded(18.0, 0.0))) == ("not measured", "")
    no_figure = replace(AXIS, certified=replace(CERTIFIED, gain=None))
    assert state_of(exact(loaded(18.0)), no_figure) == ("not measured", "")
    late = "delay: 801.0 us from sample to actuator, made for 800 us"
    assert state_of(exact(loaded(18.0), 801)) == ("premise left", late)
    state, why = state_of(exact(loaded(18.0), 500, 400))
    assert state == "premises not known"
    assert why.startswith("delay: 500.0 to 900.0 us from sample")
    assert state_of(loaded(18.0))[1] == "delay: from sample to actuator nothing was measured"
    assert state_of(exact(loaded(18.0)), replace(AXIS, certified=replace(CERTIFIED, left=("J",)))) == (
        "premise left",
        "J",
    )


def test_losses_and_the_age_of_a_sample_are_premises() -> None:
    rows = exact(loaded(18.0))
    rows["fate"][332:334] = 1
    assert state_of(rows)[0] == "exceeded"
    aged = replace(AXIS, certified=replace(CERTIFIED, age_us=3_400.0))
    assert state_of(rows, aged)[1] == "age: a sample that acts for 3500.0 us, made for at most 3400 us"
    assert state_of(rows, replace(AXIS, certified=replace(CERTIFIED, age_us=3_500.0)))[0] == "exceeded"
    rows["fate"][334] = 1
    assert state_of(rows) == (
        "premise left",
        "losses: 3 in a row, readings and commands together, made for at most 2",
    )


def test_a_certificate_for_lost_samples_presumes_a_constant_delay_and_every_command() -> None:
    axis = replace(AXIS, certified=replace(CERTIFIED, samples_alone=True))
    assert state_of(exact(loaded(18.0), 800), axis) == ("exceeded", "")
    assert state_of(exact(loaded(17.0), 796, 8), axis) == ("kept", ""), "as near as clocks tell"
    state, why = state_of(exact(loaded(17.0), 780), axis)
    assert state == "premise left"
    assert why == "constant delay: 780.0 us from sample to actuator, certified for 800 us alone"
    assert state_of(exact(loaded(17.0), 780))[0] == "kept", "other certificates cover shorter delays"
    rows = exact(loaded(17.0), 800)
    rows["command_fate"][700:703] = COMMAND_FATES.index(CommandFate.LOST)
    state, why = state_of(rows, axis)
    assert state == "premise left"
    assert "commands: 3 lost, certified where every one arrives" in why


def test_a_command_at_a_limit_after_the_load_step_leaves_the_premises() -> None:
    slewed = replace(AXIS, certified=replace(CERTIFIED, torque_step_max_nm=1.0))
    for place, state in ((10, "exceeded"), (STEP_AT + 10, "premise left")):
        rows = exact(loaded(18.0))
        rows["command_torque_nm"][place] = -5.0
        assert state_of(rows)[0] == state
        rows["command_torque_nm"][place] = 0.9
        assert state_of(rows, slewed)[0] == "exceeded"
        rows["command_torque_nm"][place] = 1.0
        assert state_of(rows, slewed)[0] == state
        rows["command_torque_nm"][place] = 0.0
        rows["statusword"][place] |= 1 << 11
        assert state_of(rows)[0] == state


def test_what_the_error_did_before_the_step_is_no_gain() -> None:
    """The rms after it grows by the noise's own largest at most, whatever its shape."""
    ripple = 0.5 * np.sign(np.sin(2.0 * np.pi * np.arange(COUNT) / 40.0 + 0.1))
    rows = exact(loaded(17.2))
    rows["velocity_rad_s"] -= ripple
    found = meter_of(rows).figures()["gain_rad_s_nm"]
    assert found["seen"] > 17.0 > found["seen_at_least"]
    assert state_of(rows) == ("kept", "")
    rows["velocity_rad_s"] -= np.where(np.arange(COUNT) >= STEP_AT, 1.5, 0.0)
    assert state_of(rows) == ("exceeded", "")


def test_delay_and_losses_are_of_its_own_axis() -> None:
    rows = loaded(5.0)
    rows["axis"] = 3
    rows["fate"][100:102] = 1
    exact(rows, 500, 500)
    figures = meter_of(rows).figures()
    assert figures["action_delay_us"] == {"certified": 800.0, "seen": 500.0, "seen_at_most": 1000.0}
    assert figures["losses_together"] == {"certified": 2, "seen": 2, "seen_at_most": 2}
    (line,) = certificate_lines({"axis1": figures}).values()
    assert "delay to actuation [us] 800, seen 500 to 1000;" in line
    assert "current loop [Hz] 504 to 1269, the drive's 800" in line
    rows["command_fate"] = COMMAND_FATES.index(CommandFate.NOT_MEASURED)
    (line,) = certificate_lines({"axis1": meter_of(rows).figures()}).values()
    assert "delay to actuation [us] 800, seen not known" in line


def test_a_plan_goes_to_the_logger_and_back() -> None:
    for axis in (AxisPlan("axis1", 1.0, 2.0, CERTIFIED), AxisPlan("axis1", 1.0)):
        assert from_plain(AxisPlan, json.loads(json.dumps(asdict(axis)))) == axis
