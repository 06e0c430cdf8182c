"""A shaft that is known exactly, in place of drive and bus, for the steps of commissioning.

It turns by the torque, or follows the speed, of each cycle, and is recorded as by the Exerciser.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import numpy as np

from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.record import values_of
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.commissioning.dialog import Dialog, Idle
from servobench.hil.commissioning.excitation import SpeedReference
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import Findings
from servobench.hil.commissioning.identify import Mechanics
from servobench.hil.commissioning.request import CommissionRequest, Nameplate, motion_limits
from servobench.hil.commissioning.session import Session
from servobench.hil.execution.segments import timing_without_bench
from servobench.hil.loop.samples import StateEstimate
from servobench.hil.loop.scenario import Quantity, ReferenceProfile, Segment
from tests.unit.hil.cycles import advance, in_cycle

PERIOD: Final = Duration(NS_PER_MS)
WATCHED: Final = "its commands are watched by 6074h; its mode by 6061h"
PERIOD_S: Final = 1e-3
RATED_NM: Final = 1.6
LIMITS: Final = motion_limits(Nameplate(), RATED_NM, 3000.0)
POSITION_RAD: Final = math.tau / 65536
VELOCITY_RAD_S: Final = math.tau / 6000


def shaft_of(
    inertia_kg_m2: float, viscous_nm_s: float = 0.0, coulomb_nm: float = 0.0, offset_nm: float = 0.0
) -> Mechanics:
    """As it is, without any uncertainty."""
    return Mechanics(inertia_kg_m2, viscous_nm_s, coulomb_nm, offset_nm, 0.0, 0.0, 0.0, 0, 0.0)


class Objects:
    """A dictionary of a drive: holds what is written to it, refuses it, or holds something else."""

    def __init__(self, held: dict[tuple[int, int], int] | None = None) -> None:
        self.held = held or {}
        self.stubborn: set[int] = set()
        """Indices that keep what they hold."""
        self.written: list[tuple[int, int, str, int]] = []

    def read(self, index: int, sub: int = 0, _code: str = "I") -> int:
        return self.held[index, sub]

    def read_if_there(self, index: int, sub: int = 0, _code: str = "I") -> int | None:
        return self.held.get((index, sub))

    def write(self, index: int, sub: int, code: str, value: int) -> None:
        self.written.append((index, sub, code, value))
        if index not in self.stubborn:
            self.held[index, sub] = value

    def write_verified(self, index: int, sub: int, code: str, value: int) -> None:
        self.write(index, sub, code, value)
        if self.held[index, sub] != value:
            raise SettingRefused(f"{index:04X}h holds {self.held[index, sub]}")


@dataclass
class Shaft:
    """Stands in for the Exerciser."""

    truth: Mechanics
    objects: Objects = field(default_factory=Objects)
    quantity: Quantity = Quantity.TORQUE
    mode: Mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE
    position_sign: int = 1
    """-1: a positive set-point turns it down."""
    velocity_factor: float = 1.0
    """What the velocity tells of the slope of the position; negative: it counts against it."""
    torque_factor: float = 1.0
    blocked: bool = False
    one_way: bool = False
    lost: int = 0
    period_s: float = PERIOD_S
    limits: Any = LIMITS
    runs: int = 0

    @property
    def port(self) -> Any:
        return SimpleNamespace(quantity=self.quantity, mode=self.mode, watched_by=WATCHED)

    def run(
        self,
        controller: Any,
        duration: float,
        reference: list[Segment] | None = None,
        done: Callable[[], bool] = lambda: False,
        guard_speed: bool = True,  # noqa: ARG002 - as the Exerciser
    ) -> Recording:
        """A cycle each period; what is recorded with a sample is the torque that acted until then."""
        self.runs += 1
        profile = ReferenceProfile(reference or [])
        angle = speed = acted = 0.0
        rows = []
        for cycle in range(1, round(duration / PERIOD_S)):
            time_s = cycle * PERIOD_S
            told = self._told(angle, speed, acted)
            rows.append((time_s, *told))
            instant = Instant(round(time_s * NS_PER_S))
            estimate = StateEstimate(told[0], told[1], told[2], instant, cycle)
            asked = cast(float, values_of(controller.output(in_cycle(estimate, profile.value(time_s))))[0])
            advance(controller, estimate, asked)
            if done():
                break
            angle, speed, acted = self._on(angle, speed, asked)
        columns = np.array(rows).T
        delays = np.full(len(rows), 250.0)
        return Recording(
            columns[0], columns[1], columns[2], columns[3], delays, len(rows), self.lost, (self.lost,)
        )

    def run_speeds(
        self, duration: float, reference: list[Segment] | None = None, guard_speed: bool = True
    ) -> Recording:
        """As :meth:`run`, by a loop of the drive's own that leaves no error."""
        return self.run(SpeedReference(), duration, reference, guard_speed=guard_speed)

    def rest(self, duration: float) -> Recording:
        return self.run(SpeedReference(), duration)

    def _told(self, angle: float, speed: float, torque_nm: float) -> tuple[float, float, float]:
        polarity = self.objects.held.get((Object.POLARITY, 0), 0)
        sign = self.position_sign * (-1 if polarity & 0x80 else 1)
        turned = abs(angle) if self.one_way else sign * angle
        velocity = sign * self.velocity_factor * (-1 if polarity & 0x40 else 1) * speed
        if polarity & 0x80:
            velocity = -velocity
        return turned, velocity, self.torque_factor * torque_nm

    def _on(self, angle: float, speed: float, asked: float) -> tuple[float, float, float]:
        """Angle and speed a period later, and the torque until then."""
        if self.blocked:
            return angle, 0.0, asked
        truth = self.truth
        if self.quantity is Quantity.SPEED:
            change, mean = asked - speed, 0.5 * (asked + speed)
            torque = truth.inertia_kg_m2 * change / PERIOD_S + truth.friction_nm(mean) + truth.offset_nm
            return angle + mean * PERIOD_S, asked, torque
        push = asked - truth.offset_nm
        if speed == 0.0 and abs(push) <= truth.coulomb_friction_nm:
            return angle, 0.0, asked
        direction = math.copysign(1.0, speed or push)
        rate = truth.viscous_friction_nm_s / truth.inertia_kg_m2
        gain = (push - direction * truth.coulomb_friction_nm) / truth.inertia_kg_m2
        fade = math.exp(-rate * PERIOD_S)
        share = -math.expm1(-rate * PERIOD_S) / rate if rate else PERIOD_S
        later = speed * fade + gain * share
        if later * direction < 0.0:  # it comes to rest within the period
            return angle + 0.5 * speed * PERIOD_S, 0.0, asked
        path = speed * share + (gain * (PERIOD_S - share) / rate if rate else 0.5 * gain * PERIOD_S**2)
        return angle + path, later, asked


def request_of(plate: Mapping[str, Any] | None = None, **more: Any) -> CommissionRequest:
    """For node 5; ``plate``: what its nameplate says."""
    return CommissionRequest("hub:x", 5, Path("out"), nameplate=Nameplate.model_validate(plate or {}), **more)


class Answering(Dialog):
    """Somebody who gives ``answer`` to each question; None: nobody is there."""

    def __init__(self, answer: str | None = None) -> None:
        super().__init__(lambda _text: None)
        self.attended = answer is not None
        self.asked: list[str] = []
        self._answer = answer

    def line(self, question: str, _idle: Idle) -> str:
        self.asked.append(question)
        return self._answer or ""


def session_of(shaft: Shaft, **more: Any) -> Session:
    """A commissioning under way that has this shaft; ``more``: of the session.

    ``configured`` counts how often it was configured, ``pictures`` holds the names of what was drawn.
    """
    scaling = Scaling(
        POSITION_RAD, VELOCITY_RAD_S, VELOCITY_RAD_S, RATED_NM, RATED_NM / 1000.0,
        sources={"position": "608Fh", "velocity": "60A9h"},
    )  # fmt: skip
    found = Findings(told=scaling, limits=LIMITS, reading_delay_us=0.0, effect_delay_us=0.0)
    pictures: list[str] = []
    configured: list[None] = []
    torque_mode = shaft.mode if shaft.quantity is Quantity.TORQUE else None

    @contextmanager
    def exercising(_limits: object = None) -> Iterator[Shaft]:
        yield shaft

    def overridden(**changes: Any) -> None:
        found.override = replace(found.override, **changes)

    session = SimpleNamespace(
        request=request_of(),
        dialog=Answering(),
        idle=lambda: None,
        limits=LIMITS,
        found=found,
        told=scaling,
        units=scaling,
        position_rad=POSITION_RAD,
        velocity_rad_s=VELOCITY_RAD_S,
        acceleration_rad_s2=VELOCITY_RAD_S,
        rated_torque_nm=RATED_NM,
        drive=SimpleNamespace(rated_torque_nm=RATED_NM),
        objects=shaft.objects,
        port=shaft.port,
        exercising=exercising,
        torque_mode=lambda: torque_mode,
        timing=lambda: timing_without_bench(PERIOD, 1_000_000, Duration(0)),
        overridden=overridden,
        configure=lambda: configured.append(None),
        configured=configured,
        meanwhile=lambda work, *arguments, **options: work(*arguments, **options),
        picture=lambda _outcome, name, *_arguments: pictures.append(name),
        pictures=pictures,
        most_told=lambda _index: None,
    )
    for name, value in more.items():
        setattr(session, name, value)
    return cast(Session, session)
