"""What a controller was made for against bench and network: each message in whole, each limit at its edge."""

from dataclasses import replace
from typing import Any

import pytest

from servobench.drivers.errors import BadInput, LimitExceeded
from servobench.drivers.record import replaced
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.configuration.controller_files import MadeFor
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.configuration.network_file import Network
from servobench.hil.execution.network_guard import REMEDY, Allowed, Certificates, allowed
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.samples import CommandFate, Sample, Sending
from servobench.hil.rows.recording_plan import CertifiedPlan
from tests.unit.hil.loop_fakes import reading_at
from tests.unit.hil.test_network_guard import LIMITS, MADE_FOR, PERIOD, REAL, Watched, bench, record

KEY = "drive.axis1.controller.made_for"
SIMULATION = "drive.axis1.simulation"
WORSE = "axis1: the network is worse than its controller's: "
FLEXIBLE = LING2012.tables | {"coupling": {"inertia_ratio": 4.0, "antiresonance_hz": 60.0}}
ON_AN_ARM = LING2012.tables | {
    "load": {"arm": {"torque_nm": 0.5}, "end_stops": {"positive_rad": 9.0, "stiffness_nm_rad": 80.0}}
}
GOOD = {"period_us": 2000, "losses_in_a_row_max": 3, "delay_max_us": 1000}


def told(*delays_us: int | None, limits: Allowed = LIMITS) -> list[str]:
    """What is said of cycles with these delays, None for one without a reading."""
    watched = Watched(refuse=False, limits=limits)
    watched.feed(*delays_us)
    assert len(watched.records) == len(delays_us)
    return watched.told


@pytest.mark.parametrize(
    ("delays_us", "said"),
    [
        ([None] * 3, []),
        ([None] * 4, ["4 readings lost in a row, made for at most 3 readings and commands"]),
        ([None, None, 1000, None, None], []),
        ([1000], []),
        ([1001], ["1001.0 us from sample to actuation, made for at most 1000 us"]),
        ([1001, 1002], ["1001.0 us from sample to actuation, made for at most 1000 us"]),
    ],
)
def test_what_is_worse_is_told_in_whole_from_its_limit_on(
    delays_us: list[int | None], said: list[str]
) -> None:
    assert told(*delays_us) == [WORSE + text for text in said]


OLD = Allowed(3, Duration(7_000_000), Duration(9_000_000))
"""Of a constant delay of 9 ms: losses and delay share the age."""


@pytest.mark.parametrize(
    ("delays_us", "said"),
    [
        ([None, None, None, 1000], []),
        ([None, None, None, 1001], ["a sample that acts for 9001.0 us, made for at most 9000 us"]),
        ([None, 5001, 1000], ["a sample that acts for 9001.0 us, made for at most 9000 us"]),
        # the losses were told already: the age that follows from them is not told again
        (
            [None, None, None, None, 1000],
            ["4 readings lost in a row, made for at most 3 readings and commands"],
        ),
        # each reading ends the losses before it
        ([None, 1000, None, None, 3000, 7000], []),
        ([None, 5001, 7001], ["a sample that acts for 9001.0 us, made for at most 9000 us"]),
    ],
)
def test_losses_and_delay_share_the_age_of_a_sample(delays_us: list[int | None], said: list[str]) -> None:
    assert told(*delays_us, limits=OLD) == [WORSE + text for text in said]


def test_what_ends_a_run_says_what_to_do() -> None:
    with pytest.raises(LimitExceeded) as caught:
        Watched().feed(1001)
    text = f"{WORSE}1001.0 us from sample to actuation, made for at most 1000 us"
    assert str(caught.value) == str(LimitExceeded(text, remedy=REMEDY))


def test_a_run_that_stops_loses_readings_without_being_told() -> None:
    watched = Watched(refuse=True, stopping=True)
    watched.feed(*[None] * 9, 5000)
    assert watched.told == []
    assert len(watched.records) == 10


def sent(late_ns: int, **sending: Any) -> CycleRecord:
    """A command handed over 900 us after the sample, its reading received ``late_ns`` after that."""
    made = record(1, 300)
    assert isinstance(made.observation, Sample)
    handed_at = Instant(PERIOD + 900_000)
    reading = reading_at(Instant(handed_at + late_ns))
    told: dict[str, Any] = {"on_bus_at": None, "acts_after": None} | sending
    command = Sending(0, handed_at, told["on_bus_at"], CommandFate.NOT_MEASURED, told["acts_after"], None)
    return replaced(made, observation=replaced(made.observation, reading=reading), sending=command)


@pytest.mark.parametrize(
    ("late_ns", "sending", "delay_us"),
    [
        (-100_000, {}, 900),
        (-100_000, {"on_bus_at": Instant(PERIOD + 950_000)}, 950),
        (-100_000, {"on_bus_at": Instant(PERIOD + 950_000), "acts_after": Instant(PERIOD + 1_300_000)}, 1300),
        # a reading that came after its cycle's command acts with the next one that is sent
        (0, {}, 900),
        (1, {}, 2900),
        (2_000_000, {}, 2900),
        (2_000_001, {}, 4900),
    ],
)
def test_a_delay_is_the_least_that_it_certainly_was(
    late_ns: int, sending: dict[str, Any], delay_us: int
) -> None:
    for limit_us, worse in ((delay_us, False), (delay_us - 1, True)):
        watched = Watched(refuse=False, limits=Allowed(9, Duration(limit_us * 1_000), Duration(1 << 40)))
        watched.guard(sent(late_ns, **sending))
        text = f"{WORSE}{delay_us:.1f} us from sample to actuation, made for at most {limit_us} us"
        assert watched.told == ([text] if worse else [])


def test_a_cycle_without_a_command_delays_nothing() -> None:
    watched = Watched(limits=Allowed(0, Duration(0), Duration(2_000_000)))
    watched.guard(replaced(record(1, 300), sending=None))
    assert len(watched.records) == 1


@pytest.mark.parametrize(
    ("made_for", "expected"),
    [
        ({"losses_in_a_row_max": 0, "delay_max_us": 700}, (0, 700_000, 2_700_000)),
        ({"losses_in_a_row_max": 2, "delay_max_us": 0}, (2, 0, 6_000_000)),
        ({"losses_in_a_row_max": 2}, (3, 7_000_000, 9_000_000)),
        ({"delay_max_us": 100}, (3, 7_000_000, 9_000_000)),
        ({"delay_us": 4_000}, (1, 2_000_000, 4_000_000)),
        ({"delay_us": 3_999}, (0, 1_999_000, 3_999_000)),
        ({"delay_us": 1_000}, (0, -1_000_000, 1_000_000)),
    ],
)
def test_the_worst_network_that_is_allowed(made_for: dict[str, int], expected: tuple[int, int, int]) -> None:
    losses, delay, age = expected
    found = allowed(MadeFor(**{"delay_us": 9_000} | made_for), PERIOD)  # type: ignore[arg-type]
    assert found == Allowed(losses, Duration(delay), Duration(age))


def faults_of(made_for: dict[str, Any], actuation: str = "on_arrival", **drive: Any) -> list[BadInput]:
    return Certificates(bench(made_for, actuation, **drive)).faults({})


def texts(faults: list[BadInput]) -> list[tuple[str, str, object, str, str]]:
    return [(each.source, each.key, each.value, each.expected, each.remedy) for each in faults]


def without(*keys: str) -> dict[str, Any]:
    return {key: value for key, value in MADE_FOR.items() if key not in keys}


def test_another_period_is_told_in_whole() -> None:
    assert texts(faults_of(MADE_FOR | {"period_us": 1000})) == [
        ("bench.toml", f"{KEY}.period_us", 1000, "loop.period_us = 2000", REMEDY)
    ]


@pytest.mark.parametrize(("delay_us", "count"), [(4_000, 0), (3_999, 1)])
def test_a_constant_delay_covers_two_periods(delay_us: int, count: int) -> None:
    found = faults_of(without("period_us", "losses_in_a_row_max", "delay_max_us") | {"delay_us": delay_us})
    expected = "at least two periods of 2000 us: a sample acts that long without any loss"
    assert texts(found) == [("bench.toml", f"{KEY}.delay_us", 3_999, expected, REMEDY)] * count


STAMP = {"kind": "stamp", "delay_us": 4000}


@pytest.mark.parametrize(
    ("made_for", "compensator", "value", "expected"),
    [
        (MADE_FOR, STAMP, "arrival", "the bench's compensator, stamp at 4000 us"),
        (
            MADE_FOR | {"strategy": "stamp", "agreed_delay_us": 6_000},
            STAMP,
            "stamp at 6000 us",
            "the bench's compensator, stamp at 4000 us",
        ),
        (
            MADE_FOR | {"strategy": "stamp", "agreed_delay_us": 4_000},
            {"kind": "arrival"},
            "stamp at 4000 us",
            "the bench's compensator, arrival",
        ),
    ],
)
def test_another_compensator_is_told_in_whole(
    made_for: dict[str, Any], compensator: dict[str, Any], value: str, expected: str
) -> None:
    found = faults_of(made_for, "on_sync", compensator=compensator)
    assert texts(found) == [("bench.toml", f"{KEY}.strategy", value, expected, REMEDY)]


@pytest.mark.parametrize(
    ("factor", "count"), [(1.0 + 0.9e-6, 0), (1.0 - 0.9e-6, 0), (1.0 + 1.1e-6, 1), (0.5, 1)]
)
def test_a_motor_is_the_same_within_a_millionth(factor: float, count: int) -> None:
    real = LING2012.parameters.inertia_kg_m2
    plant = MADE_FOR["plant"] | {"inertia_kg_m2": factor * real}
    expected = f"that of the motor {LING2012.parameters.name}, {real:g}"
    assert (
        texts(faults_of(MADE_FOR | {"plant": plant}))
        == [("bench.toml", f"{KEY}.plant.inertia_kg_m2", factor * real, expected, REMEDY)] * count
    )


@pytest.mark.parametrize(
    ("change", "key", "value", "expected"),
    [
        ({"period_us": 1000}, "network.period_us", 1000, "the loop's, 2000"),
        (
            {"losses_in_a_row_max": 4},
            "network.losses_in_a_row_max",
            4,
            "at most 3, for which the controller was made",
        ),
        (
            {"delay_max_us": 1001},
            "network.delay_max_us",
            1001,
            "at most 1000, for which the controller was made",
        ),
    ],
)
def test_a_worse_network_is_told_in_whole(
    change: dict[str, int], key: str, value: int, expected: str
) -> None:
    network = Network.model_validate(GOOD | change)
    found = Certificates(bench(MADE_FOR)).faults({"good": Network.model_validate(GOOD), "n.toml": network})
    assert texts(found) == [("n.toml", key, value, expected, REMEDY)]


def test_of_a_constant_delay_the_age_counts_and_is_told_where_nothing_else_is() -> None:
    config = bench({"delay_us": 9_000})
    old = Network(period_us=2000, losses_in_a_row_max=2, delay_max_us=3001)
    expected = "a sample that acts for at most 9000 us, losses included"
    assert texts(Certificates(config).faults({"n.toml": old})) == [
        ("n.toml", "network", "9001 us", expected, REMEDY)
    ]
    older = Network(period_us=2000, losses_in_a_row_max=2, delay_max_us=7001)
    assert [fault.key for fault in Certificates(config).faults({"n.toml": older})] == ["network.delay_max_us"]


def test_without_a_certified_controller_no_network_is_asked() -> None:
    pid = {"kind": "pid", "proportional_nm_s_rad": 0.02}
    certificates = Certificates(bench(MADE_FOR, controller=pid))
    unknown = Network(period_us=2000, losses_in_a_row_max=0, delay_max_us=300, commands="not measured")
    assert certificates.faults({"n.toml": unknown}) == []
    assert certificates.plans() == {}
    records: list[CycleRecord] = []
    assert certificates.watched("axis1", records.append, print, lambda: False) == records.append


def test_a_guarded_axis_notes_what_it_tells() -> None:
    certificates = Certificates(bench(MADE_FOR))
    said: list[str] = []
    certificates.check(None, allow=True)
    records: list[CycleRecord] = []
    take = certificates.watched("axis1", records.append, said.append, lambda: False)
    take(record(1, 1001))
    text = f"{WORSE}1001.0 us from sample to actuation, made for at most 1000 us"
    assert (said, certificates.notes, len(records)) == ([text], [text], 1)
    certificates.check(None, allow=False)
    with pytest.raises(LimitExceeded):
        certificates.watched("axis1", records.append, said.append, lambda: False)(record(1, 1001))


PLAN = CertifiedPlan(
    period_us=2000,
    delay_us=1000.0,
    losses_together=3,
    bandwidths_hz=(500.0, 1200.0),
    bandwidth_hz=800.0,
    age_us=9000.0,
)


@pytest.mark.parametrize(
    ("made_for", "drive", "changed"),
    [
        (MADE_FOR, {}, {}),
        (MADE_FOR | {"torque_rms_nm_max": 0.3}, {}, {"torque_rms_nm_max": 0.3}),
        (
            MADE_FOR,
            {"limits": {"speed_max_rpm": 2000.0, "torque_max_nm": 5.0, "torque_slew_max_nm_s": 300.0}},
            {"torque_step_max_nm": pytest.approx(0.6)},
        ),
        (
            MADE_FOR,
            {"simulation": {"current_bandwidth_hz": 1300.0}},
            {
                "bandwidth_hz": 1300.0,
                "left": (
                    "drive.axis1.simulation.current_bandwidth_hz: 1300 Hz, expected a loop of first order of "
                    f"500 to 1200 Hz, for which {KEY}.current_loop certifies the controller",
                ),
            },
        ),
        (
            MADE_FOR,
            {"simulation": {"resistance_factor": 1.25, "inductance_factor": 0.5}},
            {
                "left": (
                    f"{SIMULATION}.resistance_factor: 1.25, expected 1, the motor as its file has it",
                    f"{SIMULATION}.inductance_factor: 0.5, expected 1, the motor as its file has it",
                )
            },
        ),
        (
            MADE_FOR,
            {"simulation": {"motor": FLEXIBLE}},
            {"left": (f"{SIMULATION}.motor.coupling: resonance at 134 Hz, expected a rigid shaft",)},
        ),
        (
            MADE_FOR,
            {"simulation": {"motor": ON_AN_ARM}},
            {
                "left": (
                    f"{SIMULATION}.motor.load: arm, end_stops, expected a load torque that no place or speed "
                    "changes",
                )
            },
        ),
        (without("current_loop", "plant"), {}, {"bandwidths_hz": None}),
    ],
)
def test_what_the_figures_of_a_run_are_held_against(
    made_for: dict[str, Any], drive: dict[str, Any], changed: dict[str, Any]
) -> None:
    assert Certificates(bench(made_for, **drive)).plans() == {"axis1": replace(PLAN, **changed)}


def test_of_a_drive_that_nobody_measured_the_bandwidth_is_not_known() -> None:
    certificates = Certificates(bench(MADE_FOR, simulation={"resistance_factor": 2.0}).as_run(REAL, None))
    unknown = "bandwidth: that of the drive's current loop is not known"
    assert certificates.plans() == {"axis1": replace(PLAN, bandwidth_hz=None, unknown=(unknown,))}
    assert certificates.doubts() == [
        "axis1: the bandwidth of the drive's current loop is not known, its controller is certified for "
        "500 to 1200 Hz; hil commission measures it"
    ]
    assert Certificates(bench(without("current_loop", "plant")).as_run(REAL, None)).doubts() == []


def test_a_replaced_axis_says_nothing() -> None:
    config = bench(MADE_FOR | {"period_us": 1000})
    certificates = Certificates(config, {"axis1"})
    assert (certificates.faults({}), certificates.plans(), certificates.doubts()) == ([], {}, [])


def test_a_pid_around_a_slow_current_loop_is_doubted() -> None:
    pid = {"kind": "pid", "proportional_nm_s_rad": 0.5}
    slow = bench(MADE_FOR, controller=pid, simulation={"current_bandwidth_hz": 50.0})
    (doubt,) = Certificates(slow).doubts()
    assert doubt.startswith("axis1: its PID crosses over at ")
    assert Certificates(slow, {"axis1"}).doubts() == []
    fast = bench(MADE_FOR, controller=pid | {"proportional_nm_s_rad": 0.005})
    assert Certificates(fast).doubts() == []
