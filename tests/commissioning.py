"""Commissioning of drives that were drawn from a seed, in simulated time, and how far off it is."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.commission import all_steps, commission
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop
from servobench.hil.commissioning.findings import StepOutcome
from servobench.hil.commissioning.report import Commissioned
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.configuration.bench_file import faults_from
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.write_lists import COMMISSION
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.drive.data_sheet import only_modes
from servobench.virtual_bus.drive.lacks import take_away
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import Truth, unknown_drive
from servobench.virtual_bus.frame import Frame
from tests.scenario.foreign_node import put_on_the_bus
from tests.sdo_writes import SdoWrites

LOSS = {
    "loss": [
        {"direction": direction, "probability": 0.01} for direction in ("host_to_drive", "drive_to_host")
    ]
}
"""One PDO in a hundred, each way."""
LATE = {"delay": [{"direction": "drive_to_host", "delay_min_us": 0, "delay_max_us": 7000}]}
"""A host that is busy."""


SYNC = 0x080
RPDO = 0x201
LAST_TPDO = 0x281


@dataclass(frozen=True, slots=True)
class Errors:
    """What was found against what was hidden: relative errors, delays in us."""

    inertia: float
    viscous: float
    coulomb: float
    position: float
    velocity: float
    rated_torque: float
    reading_delay_us: float
    effect_delay_us: float
    missed: frozenset[str]
    """Faults that were hidden and not found."""
    invented: frozenset[str]
    """Faults that were found and are not there."""
    inertia_stated: float
    """What commissioning states as the expanded uncertainty, k = 2, of the true value; so of the next two."""
    viscous_stated: float
    coulomb_stated: float


class Spy:
    """A simulated drive that notes, inside, when it heard each SYNC and what torque it made at each tick.

    Only while ``watching``: it then wakes at every tick of its inner loops.
    """

    def __init__(self, servo: SimulatedServo) -> None:
        self._servo = servo
        self._firmware = servo.drive.firmware
        self._tick = Duration(NS_PER_S // servo.drive.drive.inner_rate_hz)
        self.watching = False
        self.syncs: list[tuple[Instant, Instant]] = []
        """Heard at, and the tick that its readings are of."""
        self.torques: list[tuple[Instant, float]] = []
        """Tick and N m."""
        self.sent: list[tuple[Instant, bytes]] = []
        """RPDOs as the host handed them to the bus."""
        self.received: list[Instant] = []
        """When the frame arrived that completes a reading."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._servo, name)

    def tap(self, way: str, can_id: int, data: bytes, _extended: bool, _remote: bool, at: Instant) -> None:
        """Fits ``BusLink.tap``."""
        if self.watching and way == "tx" and can_id == RPDO:
            self.sent.append((at, data))
        elif self.watching and way == "rx" and can_id == LAST_TPDO:
            self.received.append(at)

    @property
    def wake_at(self) -> Instant | None:
        """Of the drive, or its next tick."""
        due = self._servo.wake_at
        if not self.watching:
            return due
        tick = Instant(self._firmware.tick_at + self._tick + 1)
        return tick if due is None else min(due, tick)

    def wake(self, now: Instant) -> Sequence[Frame]:
        """Advance the inner loops, note the torque, and wake the drive if it is its time."""
        if self.watching:
            self._servo.drive.advance(now)
            self.torques.append((self._firmware.tick_at, self._firmware.inner.torque_measured_nm))
            due = self._servo.wake_at
            if due is None or due > now:
                return ()
        return self._servo.wake(now)

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """As the drive."""
        answers = self._servo.receive(frame, now)
        if self.watching and frame.can_id == SYNC:
            self.syncs.append((now, self._firmware.tick_at))
        return answers

    def reading_delay_us(self) -> float:
        """Median from a SYNC heard to its reading received."""
        heard = np.array([at for at, _ in self.syncs])
        received = np.array(self.received)
        place = np.searchsorted(heard, received) - 1
        return float(np.median(received - heard[place])) / 1e3

    def effect_delay_us(self) -> float:
        """Median from a command sent to half of its step in the motor's torque, plus the age of a sample."""
        at = np.array([tick for tick, _ in self.torques], dtype=float)
        torque = np.array([value for _, value in self.torques])
        delays = []
        for (_, before), (sent_at, data) in itertools.pairwise(self.sent):
            if data == before:
                continue
            low = int(np.searchsorted(at, sent_at))
            window = torque[low : low + 12]
            if len(window) < 12 or np.ptp(window) == 0.0:
                continue
            part = (window - window[0]) / (window[-1] - window[0])
            above = int(np.argmax(part >= 0.5))
            step = (0.5 - part[above - 1]) / (part[above] - part[above - 1])
            delays.append(at[low + above - 1] + step * self._tick - sent_at)
        ages = np.array([heard - tick for heard, tick in self.syncs])
        return float(np.median(delays) + ages.mean()) / 1e3


class WrappedStep(Step):
    """Another step to all who look at it; a subclass says what ``run`` does around that one's."""

    def __init__(self, inner: Step) -> None:
        self._inner = inner
        for name in ("name", "title", "needs", "writes", "moves", "essential"):
            setattr(self, name, getattr(inner, name))

    def left_out(self, session: Session) -> str | None:
        """As the inner one."""
        return self._inner.left_out(session)

    def plan(self, session: Session, /) -> str:
        """As the inner one."""
        return self._inner.plan(session)


class Watching(WrappedStep):
    """A step that is spied on."""

    def __init__(self, inner: Step, spy: Spy) -> None:
        super().__init__(inner)
        self._spy = spy

    def run(self, session: Session, outcome: StepOutcome) -> None:
        """As the inner one, with the spy awake."""
        session.world.link.tap(self._spy.tap)
        self._spy.watching = True
        try:
            self._inner.run(session, outcome)
        finally:
            self._spy.watching = False


def unknown_world(
    seed: int,
    folder: Path,
    *,
    faults: Mapping[str, Any] | None = None,
    drift_ppm: float = 0.0,
    period_us: int | None = None,
    spied: bool = False,
    modes: int | None = None,
    store: bool = False,
    lacks: Sequence[str] = (),
    plate: Mapping[str, Any] | None = None,
    trust_nameplate: bool = True,
    tell: Callable[[str], None] = lambda _text: None,
    last_step: str | None = None,
    without: Sequence[str] = (),
    drive: DriveParameters | None = None,
) -> tuple[Truth, Commissioned, Spy]:
    """Commission the drive of ``seed`` in simulated time. ``spied``: know the delays from inside.
    ``modes``: 6502h, if it is to be less than the drive can. ``lacks``: objects that it has not.
    ``plate``: in place of the true nameplate, which is to be trusted unless told otherwise.
    ``last_step``: no step behind that one. ``without``: nor these. ``drive``: with another machine than its
    motor alone, or another power stage.
    """
    drive = DriveParameters(clock_drift_ppm=drift_ppm) if drive is None else drive
    servo, truth = unknown_drive(seed, drive=drive)
    take_away(servo.dictionary, lacks)
    if modes is not None:
        only_modes(servo.dictionary, modes)
    request = CommissionRequest(
        bus="simulated",
        node=1,
        out=folder,
        nameplate=Nameplate.model_validate(truth.nameplate if plate is None else plate),
        period_us=period_us,
        store=store,
        trust_nameplate=trust_nameplate,
    )
    spy = Spy(servo)

    def steps() -> list[Step]:
        names = [step.name for step in all_steps()]
        last = all_steps()[: len(names) if last_step is None else names.index(last_step) + 1]
        chosen = [step for step in last if step.name not in without]
        return [Watching(step, spy) if spied and step.name == "delays" else step for step in chosen]

    fault_plan = None if faults is None else faults_from(faults, "faults")
    plan = WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, fault_plan, seed)
    with open_world(plan, [cast(CanopenDevice, spy) if spied else servo]) as world:
        heard = SdoWrites()
        put_on_the_bus(world, heard)
        world.faults.start(world.clock.now())
        result = commission(request, world, Dialog(tell), EmergencyStop(), steps=steps)
    assert heard.unlisted(COMMISSION) == []
    return truth, result, spy


def errors_of(truth: Truth, result: Commissioned, spy: Spy | None = None) -> Errors:
    """How far off. Error: AssertionError if a figure is missing."""
    found = result.findings
    mechanics, told, override = found.mechanics, found.told, found.override
    assert mechanics is not None, [(record.name, record.reason) for record in result.records]
    assert told is not None
    names = set()
    for record in result.records:
        for text in record.outcome.faults:
            for name in ("polarity", "position unit", "velocity unit", "torque unit"):
                if text.startswith(name):
                    names.add(name.removesuffix(" unit"))
    motor = truth.motor
    hidden = set(truth.faults)
    if told.velocity_rad_s > 0.0 and abs(told.velocity_rad_s / truth.velocity_rad_s - 1.0) > 0.01:
        hidden.add("velocity")  # a wrong position unit may make the velocity's wrong too
    elif "velocity" in hidden:
        hidden.discard("velocity")
    return Errors(
        inertia=mechanics.inertia_kg_m2 / motor.inertia_kg_m2 - 1.0,
        viscous=mechanics.viscous_friction_nm_s / motor.viscous_friction_nm_s - 1.0,
        coulomb=mechanics.coulomb_friction_nm / motor.coulomb_friction_nm - 1.0,
        position=(override.position_rad or told.position_rad) / truth.position_rad - 1.0,
        velocity=(override.velocity_rad_s or told.velocity_rad_s) / truth.velocity_rad_s - 1.0,
        rated_torque=(override.rated_torque_nm or told.rated_torque_nm) / truth.rated_torque_nm - 1.0,
        reading_delay_us=0.0 if spy is None else (found.reading_delay_us or 0.0) - spy.reading_delay_us(),
        effect_delay_us=0.0 if spy is None else (found.effect_delay_us or 0.0) - spy.effect_delay_us(),
        missed=frozenset(hidden - names),
        invented=frozenset(names - hidden),
        inertia_stated=mechanics.inertia_error / motor.inertia_kg_m2,
        viscous_stated=mechanics.viscous_error / motor.viscous_friction_nm_s,
        coulomb_stated=mechanics.coulomb_error / motor.coulomb_friction_nm,
    )
