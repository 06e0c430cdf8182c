"""What befalls nodes: when it strikes, and what a device then does."""

import math
from typing import Any, cast

import pytest
from scipy import stats

from servobench.drivers.cia402.profile import State
from servobench.drivers.timebase import NEVER, NS_PER_MS, NS_PER_S, Instant
from servobench.virtual_bus.bus.port import Port
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.faults.fault_log import FaultEntry, FaultLog
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.kinds.bus_off import BusOff
from servobench.virtual_bus.faults.kinds.clock_drift import ClockDrift
from servobench.virtual_bus.faults.kinds.clock_step import ClockStep
from servobench.virtual_bus.faults.kinds.drive_fault import DriveFailure, DriveFault
from servobench.virtual_bus.faults.kinds.lss_yes_sayer import LssYesSayer
from servobench.virtual_bus.faults.kinds.silence import Silence
from servobench.virtual_bus.faults.kinds.slow_drive import SlowDrive
from servobench.virtual_bus.faults.node_fault import NodeEvent, NodeFault
from servobench.virtual_bus.faults.node_faults import DrawnNode, node_source
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.faulty_device import FaultyDevice
from tests.fates import keys
from tests.motors import LING
from tests.unit.virtual_bus.servo_bench import ENABLE, ServoBench

BY_CHANCE = keys(probability_per_s=0.8)
MS = NS_PER_MS


def events(*faults: NodeFault, until_s: float, node: int = 1, seed: int = 3) -> list[NodeEvent]:
    source = DrawnNode(FaultPlan(node_faults=faults), node, seed)
    found = []
    while source.next_at() < until_s * NS_PER_S:
        found.append(source.take())
    return found


def over_current(occasion: dict[str, Any] = BY_CHANCE) -> DriveFault:
    return DriveFault(**occasion, fault="over_current")


def at(seconds: float) -> dict[str, Any]:
    return keys(at_s=1e-9 * (round(seconds * NS_PER_S)))


def test_chance_strikes_as_often_as_a_poisson_process() -> None:
    """Rate -ln(1 - p): the count over T is Poisson, the gaps are exponential."""
    seconds = 4000
    rate = -math.log(0.2)
    struck = [event.at_ns / NS_PER_S for event in events(over_current(), until_s=seconds)]
    low, high = stats.poisson.interval(0.99, rate * seconds)
    assert low < len(struck) < high
    gaps = [after - before for before, after in zip([0.0, *struck], struck, strict=False)]
    assert stats.kstest(gaps, "expon", args=(0, 1 / rate)).pvalue > 0.01
    per_second = [0] * seconds
    for when in struck:
        per_second[int(when)] += 1
    assert stats.binomtest(sum(count > 0 for count in per_second), seconds, 0.8).pvalue > 0.01


def test_chance_keeps_to_its_window() -> None:
    occasion = keys(probability_per_s=0.99, from_s=1e-9 * (2 * NS_PER_S), until_s=1e-9 * (5 * NS_PER_S))
    struck = [event.at_ns for event in events(over_current(occasion), until_s=100)]
    assert len(struck) > 5
    assert all(2 * NS_PER_S <= when < 5 * NS_PER_S for when in struck)


def test_a_schedule_strikes_once() -> None:
    found = events(over_current(at(0.5)), Silence(**at(0.2), duration_s=1e-9 * MS), until_s=100)
    assert [(event.at_ns, event.kind) for event in found] == [
        (200 * MS, "silence"),
        (500 * MS, "drive_fault"),
    ]


def test_each_kind_of_fault_of_each_node_has_a_stream_of_its_own() -> None:
    faults: list[NodeFault] = [
        over_current(),
        DriveFault(**BY_CHANCE, fault="under_voltage"),
        Silence(**BY_CHANCE, duration_s=1e-9 * MS),
        BusOff(**BY_CHANCE),
        ClockStep(**BY_CHANCE, step_min_us=-50 / 1000, step_max_us=50 / 1000),
    ]
    alone = [events(fault, until_s=20) for fault in faults]
    together = events(*reversed(faults), ClockDrift(drift_ppm=5 / 1000), until_s=20)
    for expected in alone:
        assert expected
        assert [event for event in together if event in expected] == expected
    assert len({tuple(event.at_ns for event in found) for found in alone}) == len(faults)
    assert events(over_current(), until_s=20, node=2) != alone[0]
    assert events(over_current(), until_s=20, seed=4) != alone[0]


def test_steps_of_a_clock_are_even_over_their_range() -> None:
    step = ClockStep(probability_per_s=0.9, step_min_us=-2000 / 1000, step_max_us=1000 / 1000)
    drawn = [event.a for event in events(step, until_s=2000)]
    assert stats.kstest(drawn, "uniform", args=(-2000, 3000)).pvalue > 0.01


def test_a_node_without_faults_is_left_alone() -> None:
    plan = FaultPlan(node_faults=(Silence(nodes=(2,), **at(1), duration_s=1e-9 * 1),))
    assert node_source(plan, 1, 0) is None
    assert node_source(plan, 2, 0) is not None


class FaultyBench(ServoBench):
    """The drive on the desk, with a plan around it."""

    def __init__(self, *faults: NodeFault) -> None:
        super().__init__()
        self.log = FaultLog()
        self.device = FaultyDevice(self.servo, DrawnNode(FaultPlan(node_faults=faults), 1, 3), self.log)

    def begin(self) -> None:
        """Time zero of the plan is now."""
        self.device.start_faults(self.now)
        self.zero = self.now

    def pass_ms(self, milliseconds: float) -> list[tuple[Instant, Frame]]:
        """Let time pass in the wrapped device; what it sent, and when."""
        end = self.now + round(milliseconds * MS)
        found = []
        while (due := self.device.wake_at) is not None and due <= end:
            self.now = max(self.now, due)
            found += [(self.now, frame) for frame in self.device.wake(self.now)]
            assert (self.device.wake_at or NEVER) > self.now
        self.now = Instant(end)
        return found

    def ask(self, index: int) -> list[Frame]:
        """An SDO upload request and the answers at once."""
        request = bytes([0x40, index & 0xFF, index >> 8, 0, 0, 0, 0, 0])
        return list(self.device.receive(Frame(0x601, request), self.now))


@pytest.mark.parametrize(
    ("failure", "code", "register"),
    [
        (DriveFailure.OVER_CURRENT, 0x2310, 0x03),
        (DriveFailure.OVER_TEMPERATURE, 0x4310, 0x09),
        (DriveFailure.FOLLOWING_ERROR, 0x8611, 0x21),
        (DriveFailure.UNDER_VOLTAGE, 0x3220, 0x05),
    ],
)
def test_a_fault_of_the_drive_sends_an_emergency_and_ends_in_fault(
    failure: DriveFailure, code: int, register: int
) -> None:
    bench = FaultyBench(DriveFault.model_validate({**at(0.01), "fault": failure.label}))
    bench.command(*ENABLE)
    bench.begin()
    sent = bench.pass_ms(12)
    assert (
        bench.zero + 10 * MS,
        Frame(0x081, code.to_bytes(2, "little") + bytes([register]) + bytes(5)),
    ) in sent
    assert bench.state in (State.FAULT, State.FAULT_REACTION)
    assert bench.read(0x603F, "H") == code
    assert bench.read(0x1001, "B") == register
    bench.pass_ms(500)
    assert bench.state is State.FAULT
    assert [(entry.kind, entry.at_ns) for entry in bench.log.entries()] == [("drive_fault", 10 * MS)]


def test_a_lost_encoder_stands_still_before_it_is_noticed() -> None:
    lost = DriveFault(
        **at(0.01),
        fault="encoder_loss",
        detected_after_ms=1e-6 * (3 * MS),
        duration_s=1e-9 * (100 * MS),
    )
    bench = FaultyBench(lost)
    bench.turn()
    bench.begin()
    bench.pass_ms(10.5)
    held = bench.read(0x6064, "i")
    bench.pass_ms(2)
    assert bench.state is State.OPERATION_ENABLED
    assert bench.read(0x6064, "i") == held
    assert bench.speed_rad_s > 1.0
    sent = bench.pass_ms(1)
    assert [frame.data[:2] for _, frame in sent if frame.can_id == 0x081] == [b"\x05\x73"]
    bench.pass_ms(100)
    assert bench.read(0x6064, "i") != held


def test_a_silent_node_neither_hears_nor_sends() -> None:
    bench = FaultyBench(Silence(**at(0.01), duration_s=1e-9 * (5 * MS)))
    assert bench.write(0x1017, "H", 2) is None
    bench.begin()
    sent = bench.pass_ms(12)
    assert not bench.ask(0x1000)
    assert max(when for when, frame in sent if frame.can_id == 0x701) < bench.zero + 10 * MS
    again = bench.pass_ms(10)
    assert min(when for when, frame in again if frame.can_id == 0x701) >= bench.zero + 15 * MS
    assert bench.ask(0x1000)


def test_bus_off_stops_the_drive_and_an_emergency_tells_of_its_end() -> None:
    bench = FaultyBench(BusOff(**at(0.01), recover_after_s=1e-9 * (50 * MS)))
    bench.turn()
    bench.begin()
    bench.pass_ms(20)
    assert bench.state is not State.OPERATION_ENABLED
    assert not bench.ask(0x1000)
    sent = bench.pass_ms(50)
    recovered = [(when, frame.data[:2]) for when, frame in sent if frame.can_id == 0x081]
    assert recovered[0] == (bench.zero + 60 * MS, b"\x40\x81")
    assert bench.ask(0x1000)


def test_bus_off_without_recovery_is_for_ever() -> None:
    bench = FaultyBench(BusOff(**at(0.01)))
    bench.begin()
    assert not [frame for _, frame in bench.pass_ms(5000) if frame.can_id == 0x081]
    assert not bench.ask(0x1000)


def test_a_controller_on_the_bus_is_asked_to_go_off_and_to_recover() -> None:
    asked = []

    class Controller:
        def go_bus_off(self) -> None:
            asked.append(("off", bench.now))

        def recover(self) -> None:
            asked.append(("recover", bench.now))

    bench = FaultyBench(BusOff(**at(0.01), recover_after_s=1e-9 * (4 * MS)))
    bench.device.controller = cast(Port, Controller())
    bench.begin()
    bench.pass_ms(20)
    assert asked == [("off", bench.zero + 10 * MS), ("recover", bench.zero + 14 * MS)]
    assert bench.ask(0x1000), "the controller, not the wrapper, keeps frames back"


def test_clocks_step_and_drift_as_planned() -> None:
    """1013h against the bench's time: -350 us at 10 ms, 1000 ppm from 20 ms to 1020 ms."""
    drift = ClockDrift(from_s=1e-9 * (20 * MS), until_s=1e-9 * (1020 * MS), drift_ppm=1_000_000 / 1000)
    bench = FaultyBench(
        ClockStep(**at(0.01), step_min_us=-350_000 / 1000, step_max_us=-350_000 / 1000), drift
    )
    bench.begin()
    clock = bench.servo.clock
    ahead = [clock.local_ns(bench.now) - bench.now]
    for milliseconds in (15, 505, 1000):
        bench.pass_ms(milliseconds)
        ahead.append(clock.local_ns(bench.now) - bench.now)
    assert [value - ahead[0] for value in ahead[1:]] == [-350_000, 500_000 - 350_000, 1_000_000 - 350_000]


def test_a_yes_sayer_answers_any_fast_scan_in_configuration_only() -> None:
    bench = FaultyBench(LssYesSayer())

    def lss(*request: int) -> list[Frame]:
        return list(bench.device.receive(Frame(0x7E5, bytes(request).ljust(8, b"\x00")), bench.now))

    absurd = (0x51, 1, 2, 3, 4, 31, 2, 3)
    bench.begin()
    bench.pass_ms(1)
    assert lss(*absurd) == []
    lss(0x04, 1)
    assert lss(*absurd) == [Frame(0x7E4, b"\x4f".ljust(8, b"\x00"))]
    lss(0x04, 0)
    assert lss(*absurd) == []


def test_a_slow_drive_answers_late_and_in_order() -> None:
    slow = SlowDrive(
        sdo_delay_min_us=(2 * MS) / 1000,
        sdo_delay_max_us=(5 * MS) / 1000,
        tpdo_delay_min_us=100_000 / 1000,
        tpdo_delay_max_us=900_000 / 1000,
    )
    bench = FaultyBench(slow)
    first = bench.now
    for _ in range(20):
        assert not bench.ask(0x1000)
        assert not bench.device.receive(Frame(0x80), bench.now)
    sent = bench.pass_ms(10)
    assert [frame.can_id for _, frame in sent if frame.can_id < 0x580] == [0x181, 0x281] * 20
    answers = [when - first for when, frame in sent if frame.can_id == 0x581]
    assert len(answers) == 20
    assert answers[0] >= 2 * MS
    assert answers[-1] <= 5 * MS
    late = [entry for entry in bench.log.entries() if entry.kind == "late"]
    assert [entry.n for entry in late if entry.can_id == 0x581] == list(range(20))


def test_lateness_is_even_over_its_range() -> None:
    source = DrawnNode(
        FaultPlan(node_faults=(SlowDrive(sdo_delay_min_us=10 / 1000, sdo_delay_max_us=90_000 / 1000),)),
        1,
        3,
    )
    drawn = [source.lateness(0x581) for _ in range(5000)]
    assert stats.kstest(drawn, "uniform", args=(10, 89_990)).pvalue > 0.01
    assert {source.lateness(0x181), source.lateness(0x081), source.lateness(0x701)} == {0}


def booting(log: FaultLog | None = None) -> FaultyDevice:
    slow = SlowDrive(boot_min_s=(300 * MS) / 1e9, boot_max_s=(300 * MS) / 1e9)
    servo = SimulatedServo(1, LING)
    return FaultyDevice(servo, DrawnNode(FaultPlan(node_faults=(slow,)), 1, 3), log)


def run_to(device: FaultyDevice, end: int) -> list[tuple[Instant, Frame]]:
    found = []
    while (due := device.wake_at) is not None and due <= end:
        found += [(due, frame) for frame in device.wake(due)]
    return found


def test_a_slow_boot_holds_the_boot_up_and_hears_nothing_meanwhile() -> None:
    log = FaultLog()
    device = booting(log)
    assert not device.start(Instant(0))
    assert not device.receive(Frame(0x601, bytes([0x40, 0, 0x10, 0, 0, 0, 0, 0])), Instant(MS))
    assert run_to(device, 400 * MS) == [(Instant(300 * MS), Frame(0x701, b"\x00"))]
    for command, begin in ((0x81, 500), (0x82, 900)):
        assert not device.receive(Frame(0x000, bytes([command, 0])), Instant(begin * MS))
        sent = run_to(device, (begin + 350) * MS)
        assert sent == [(Instant((begin + 300) * MS), Frame(0x701, b"\x00"))]
    assert not device.receive(Frame(0x000, b"\x81\x02"), Instant(1500 * MS))
    assert run_to(device, 2000 * MS) == []
    assert log.entries() == [
        FaultEntry(begin * MS, 300 * MS, 0, 0, 0, n, log.entries()[0].code, 1)
        for n, begin in enumerate((0, 500, 900))
    ]


def test_what_befell_before_the_end_ends_after_it() -> None:
    bench = FaultyBench(Silence(**at(0.01), duration_s=1e-9 * (50 * MS)), over_current(at(0.03)))
    bench.begin()
    bench.pass_ms(20)
    bench.device.stop_faults()
    bench.pass_ms(60)
    assert bench.state is State.SWITCH_ON_DISABLED
    assert bench.ask(0x1000)
