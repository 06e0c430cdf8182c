"""Of a shaft that may only turn so far: what the steps of commissioning ask, held against a simulated one."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.record import values_of
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.commissioning.excitation import SpeedReference
from servobench.hil.commissioning.findings import StepFailed
from servobench.hil.commissioning.identify import Mechanics
from servobench.hil.commissioning.request import Nameplate, motion_limits
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_design import Verify
from servobench.hil.commissioning.steps_dynamics import Response
from servobench.hil.commissioning.steps_mechanics import _coasts, _ramps, top_speed
from servobench.hil.commissioning.steps_setup import _extra_limits
from servobench.hil.commissioning.steps_units import Turn, pulses
from servobench.hil.loop.samples import StateEstimate
from servobench.hil.loop.scenario import Quantity, ReferenceProfile, Segment
from tests.unit.hil.cycles import advance, in_cycle

PERIOD_S = 1e-3
RATED_NM = 1.6
LIMITS = motion_limits(Nameplate(), RATED_NM, 3000.0)
LIGHT = Mechanics(1e-4, 1e-3, 0.05, 0.0, 0.0, 0.0, 0.0, 10, 0.0)
BRAKED = Mechanics(1e-4, 0.0, 0.05, 0.0, 0.0, 0.0, 0.0, 10, 0.0)
"""Its speed falls by 500 rad/s in a second."""
SMOOTH = Mechanics(1e-2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 10, 0.0)
"""It never slows down by itself."""
TRAVELS = [0.5, 5.0]
"""On either side of 1 rad: a limit that is divided by instead of multiplied with is too far for one."""


class Shaft:
    """Stands in for the Exerciser: turns by the torque, or the speed, that it is given."""

    def __init__(self, quantity: Quantity, mechanics: Mechanics, damping_nm_s: float) -> None:
        """``damping_nm_s``: beside the friction that is known; infinite for a shaft that is held fast."""
        self.port = SimpleNamespace(quantity=quantity, mode=Mode.CYCLIC_SYNCHRONOUS_TORQUE)
        self.limits = LIMITS
        self.period_s = PERIOD_S
        self.runs: list[tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]] = []
        """Position and set-point of each."""
        self._mechanics = mechanics
        self._damping_nm_s = damping_nm_s

    def run(
        self,
        controller: Any,
        duration: float,
        reference: list[Segment] | None = None,
        done: Callable[[], bool] = lambda: False,
        guard_speed: bool = True,  # noqa: ARG002 - as the Exerciser
    ) -> Any:
        profile = ReferenceProfile(reference or [])
        position = speed = 0.0
        positions, commands = [], []
        for cycle in range(1, round(duration / PERIOD_S)):
            now = Instant(round(cycle * PERIOD_S * NS_PER_S))
            estimate = StateEstimate(position, speed, 0.0, now, cycle)
            set_point = controller.output(in_cycle(estimate, profile.value(cycle * PERIOD_S)))
            asked = cast(float, values_of(set_point)[0])
            advance(controller, estimate, asked)
            speed = self._turn(speed, asked) if self.port.quantity is Quantity.TORQUE else asked
            position += speed * PERIOD_S
            positions.append(position)
            commands.append(asked)
            if done():
                break
        self.runs.append((np.array(positions), np.array(commands)))
        return SimpleNamespace(position=np.array(positions), lost=0, cycles=len(positions))

    def run_speeds(
        self,
        duration: float,
        reference: list[Segment] | None = None,
        guard_speed: bool = True,
    ) -> Any:
        return self.run(SpeedReference(), duration, reference, guard_speed=guard_speed)

    def _turn(self, speed: float, torque: float) -> float:
        """The speed a period later; friction stops a shaft, and turns none round."""
        if math.isinf(self._damping_nm_s):
            return 0.0
        mechanics = self._mechanics
        friction = mechanics.friction_nm(speed) + self._damping_nm_s * speed
        free = speed + torque / mechanics.inertia_kg_m2 * PERIOD_S
        loss = max(abs(friction), mechanics.coulomb_friction_nm) / mechanics.inertia_kg_m2 * PERIOD_S
        return math.copysign(max(0.0, abs(free) - loss), free)


def session_of(
    travel_rad: float,
    quantity: Quantity = Quantity.TORQUE,
    mechanics: Mechanics = LIGHT,
    damping_nm_s: float = 0.0,
) -> tuple[Session, Shaft]:
    shaft = Shaft(quantity, mechanics, damping_nm_s)

    @contextmanager
    def exercising() -> Iterator[Shaft]:
        yield shaft

    torque_mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE if quantity is Quantity.TORQUE else None
    session = SimpleNamespace(
        limits=replace(LIMITS, travel_rad=travel_rad),
        found=SimpleNamespace(
            mechanics=mechanics,
            rough=None,
            limits=LIMITS,
            period=NS_PER_MS,
            controller={},
        ),
        told=SimpleNamespace(position_rad=math.tau / 4096),
        position_rad=math.tau / 4096,
        rated_torque_nm=RATED_NM,
        exercising=exercising,
        port=shaft.port,
        torque_mode=lambda: torque_mode,
    )
    return cast(Session, session), shaft


def farthest(shaft: Shaft) -> list[float]:
    return [float(np.max(np.abs(position))) for position, _ in shaft.runs]


@pytest.mark.parametrize("travel_rad", TRAVELS)
@pytest.mark.parametrize("quantity", [Quantity.TORQUE, Quantity.SPEED])
def test_pulses_take_less_than_half_of_the_travel(quantity: Quantity, travel_rad: float) -> None:
    session, shaft = session_of(travel_rad, quantity, damping_nm_s=0.05)
    pulses(session, 50.0)
    assert len(shaft.runs) >= 2
    assert max(farthest(shaft)) < 0.5 * travel_rad
    assert min(farthest(shaft)) > 0.19 * travel_rad, "so far that there is something to see"
    signs = {math.copysign(1.0, position[-1]) for position, _ in shaft.runs}
    assert signs == {-1.0, 1.0}


def test_pulses_go_as_far_as_asked_where_there_is_room() -> None:
    for travel_rad in (math.inf, 100.0):
        session, shaft = session_of(travel_rad, damping_nm_s=0.05)
        pulses(session, 0.5)
        assert all(math.pi <= far < 1.2 * math.pi for far in farthest(shaft)), travel_rad


@pytest.mark.parametrize("travel_rad", [0.01, 0.05])
def test_a_pulse_goes_twice_as_far_as_it_takes_to_see_the_shaft_move(travel_rad: float) -> None:
    """Less would not end a pulse before it is noticed; more is not needed where the travel is short."""
    session, shaft = session_of(travel_rad, damping_nm_s=0.05)
    pulses(session, 0.5)
    seen_rad = 0.003 * math.tau
    assert all(2.0 * seen_rad <= far < 2.5 * seen_rad for far in farthest(shaft))


def test_the_torque_of_a_pulse_rises_by_the_rated_torque_a_second_up_to_the_limit() -> None:
    session, shaft = session_of(math.inf, damping_nm_s=math.inf)
    with pytest.raises(StepFailed, match=r"does not turn with 0\.8 N m"):
        pulses(session, 0.5)
    ((_, torques),) = shaft.runs
    assert torques[99] == pytest.approx(RATED_NM * 0.1)
    assert max(torques) == pytest.approx(LIMITS.torque_nm, abs=2e-3 * RATED_NM)


@pytest.mark.parametrize("travel_rad", TRAVELS)
@pytest.mark.parametrize("quantity", [Quantity.TORQUE, Quantity.SPEED])
def test_the_ramps_leave_a_fifth_of_the_travel(quantity: Quantity, travel_rad: float) -> None:
    session, shaft = session_of(travel_rad, quantity, SMOOTH)
    _ramps(session, top_speed(session))
    assert len(shaft.runs) == 2
    for far in farthest(shaft):
        assert 0.6 * travel_rad < far < 0.8 * travel_rad
    assert top_speed(session_of(1e6)[0]) == top_speed(session_of(math.inf)[0]) == 0.9 * LIMITS.speed_rad_s


@pytest.mark.parametrize("travel_rad", TRAVELS)
def test_a_shaft_coasts_over_no_more_than_half_of_the_travel(travel_rad: float) -> None:
    session, shaft = session_of(travel_rad, mechanics=SMOOTH)
    _coasts(session, top_speed(session))
    assert len(shaft.runs) == 2
    for position, torque in shaft.runs:
        free = np.flatnonzero(torque[150:] == 0.0) + 150  # before the ramp it stands
        assert len(free) > 50
        path = abs(position[free[-1]] - position[free[0]])
        assert 0.4 * travel_rad < path < 0.55 * travel_rad


def test_a_shaft_coasts_down_to_a_fifth_of_its_speed() -> None:
    """At rest it would tell nothing more, and where it came to rest nobody could say."""
    session, shaft = session_of(math.inf, mechanics=BRAKED)
    top = top_speed(session)
    _coasts(session, top)
    for position, torque in shaft.runs:
        free = np.flatnonzero(torque[150:] == 0.0) + 150
        speed = np.abs(np.diff(position)) / PERIOD_S
        assert speed[free[0]] == pytest.approx(top, rel=0.05)
        assert speed[free[-2]] == pytest.approx(0.2 * top, rel=0.1)


@pytest.mark.parametrize("travel_rad", TRAVELS)
def test_the_verification_leaves_a_fifth_of_the_travel(travel_rad: float) -> None:
    speed = Verify()._speed(session_of(travel_rad)[0])
    up_and_down_s, plateau_s = 0.25, 0.5
    assert (up_and_down_s + plateau_s) * speed == pytest.approx(0.8 * travel_rad)


def test_the_verification_goes_to_half_of_the_speed_where_there_is_room() -> None:
    for travel_rad in (math.inf, 1e6):
        assert Verify()._speed(session_of(travel_rad)[0]) == 0.5 * LIMITS.speed_rad_s


@pytest.mark.parametrize(
    ("turns", "known", "left_out"),
    [
        (2.99, True, "only 2.99 turns"),
        (3.0, True, None),
        (math.inf, True, None),
        (0.1, True, "only 0.1 turns"),
    ],
)
def test_a_whole_turn_is_only_looked_for_where_three_are_allowed(
    turns: float, known: bool, left_out: str | None
) -> None:
    session, _ = session_of(turns * math.tau)
    encoder = SimpleNamespace(counts_per_revolution=4096 if known else None)
    cast(Any, session).request = SimpleNamespace(nameplate=SimpleNamespace(encoder=encoder))
    reason = Turn().left_out(session)
    assert reason == left_out if left_out is None else str(reason).startswith(left_out)


def test_no_response_is_taken_of_a_shaft_that_may_not_turn_on() -> None:
    assert Response().left_out(session_of(math.inf)[0]) is None
    assert "turn one way" in str(Response().left_out(session_of(1e3)[0]))


class Dictionary:
    """Stands in for the drive's objects: takes everything."""

    def __init__(self, position: int) -> None:
        self.held = {(int(Object.SOFTWARE_POSITION_LIMIT), sub): 0 for sub in (1, 2)}
        self._position = position

    def read(self, index: int, _sub: int, _code: str) -> int:
        assert index == Object.POSITION_ACTUAL_VALUE
        return self._position

    def read_if_there(self, index: int, sub: int = 0, _code: str = "I") -> int | None:
        return self.held.get((index, sub))

    def write_verified(self, index: int, sub: int, _code: str, raw: int) -> None:
        self.held[index, sub] = raw


@pytest.mark.parametrize(
    ("position", "travel_rad", "bounds"),
    [
        (1000, math.tau, (1000 - 4096, 1000 + 4096)),
        (2**31 - 1000, math.tau, (2**31 - 1000 - 4096, 2**31 - 1)),
        (-(2**31) + 1000, math.tau, (-(2**31), -(2**31) + 1000 + 4096)),
        (1000, math.inf, (0, 0)),
    ],
)
def test_the_drive_is_given_the_travel_about_where_it_stands(
    position: int, travel_rad: float, bounds: tuple[int, int]
) -> None:
    session, _ = session_of(travel_rad)
    objects = Dictionary(position)
    cast(Any, session).objects = objects
    _extra_limits(session)
    held = tuple(objects.held[Object.SOFTWARE_POSITION_LIMIT, sub] for sub in (1, 2))
    assert held == bounds
