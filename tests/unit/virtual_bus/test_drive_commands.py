"""Every controlword in every state, by frames on the whole drive: the arrow of the standard, or no change.

The coding of the commands and the arrows stand here once more, as in the tables of CiA 402-2 clause 6, so
that a slip in the table that drive and client share is seen.
"""

import itertools
from struct import pack

import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import State, state_of
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.servo_bench import ServoBench

DISABLED, READY, ON, ENABLED, STOP, REACTION, FAULT = (
    State.SWITCH_ON_DISABLED,
    State.READY,
    State.SWITCHED_ON,
    State.OPERATION_ENABLED,
    State.QUICK_STOP,
    State.FAULT_REACTION,
    State.FAULT,
)
WAY_TO: dict[State, tuple[int, ...]] = {
    DISABLED: (0x00,),
    READY: (0x06,),
    ON: (0x06, 0x07),
    ENABLED: (0x06, 0x07, 0x0F),
    STOP: (0x06, 0x07, 0x0F, 0x02),
    REACTION: (0x06, 0x07, 0x0F),
    FAULT: (0x00,),
}
ARROWS: dict[tuple[State, str], State] = {
    (DISABLED, "shutdown"): READY,
    (READY, "switch on"): ON,
    (READY, "enable operation"): ENABLED,
    (READY, "disable voltage"): DISABLED,
    (READY, "quick stop"): DISABLED,
    (ON, "enable operation"): ENABLED,
    (ON, "shutdown"): READY,
    (ON, "disable voltage"): DISABLED,
    (ON, "quick stop"): DISABLED,
    (ENABLED, "switch on"): ON,
    (ENABLED, "shutdown"): READY,
    (ENABLED, "disable voltage"): DISABLED,
    (ENABLED, "quick stop"): STOP,
    (STOP, "enable operation"): ENABLED,
    (STOP, "disable voltage"): DISABLED,
    (FAULT, "fault reset"): DISABLED,
}
"""Switch on and disable operation share a coding."""
BITS = (0x01, 0x02, 0x04, 0x08, 0x80)
WORDS = [sum(bits) for count in range(6) for bits in itertools.combinations(BITS, count)]


def command_in(word: int, before: int) -> str | None:
    """By the table of the standard, bits 7, 3, 2, 1, 0."""
    if word & ~before & 0x80:
        return "fault reset"
    if word & 0x80:
        return None
    if not word & 0x02:
        return "disable voltage"
    if not word & 0x04:
        return "quick stop"
    if not word & 0x01:
        return "shutdown"
    return "enable operation" if word & 0x08 else "switch on"


def bench_in(state: State) -> ServoBench:
    """Every stop takes no time or stays, so that each arrow is seen by itself."""
    bench = ServoBench()
    for index, option in (
        (Object.QUICK_STOP_OPTION, 6),
        (Object.SHUTDOWN_OPTION, 0),
        (Object.DISABLE_OPERATION_OPTION, 0),
    ):
        assert bench.write(index, "h", option) is None
    for word in WAY_TO[state]:
        bench.rpdo(word)
    if state is REACTION:
        bench.rpdo(0x0F, 800)
        bench.wait_ms(50)
    if state in (FAULT, REACTION):
        bench.servo.drive.fail(0x3210, ErrorRegister.VOLTAGE)
    assert bench.state is state
    return bench


@pytest.mark.parametrize("way", ["RPDO", "SDO"])
@pytest.mark.parametrize("state", list(WAY_TO))
def test_each_controlword_takes_its_arrow_or_changes_nothing(state: State, way: str) -> None:
    for word in WORDS:
        bench = bench_in(state)
        power = bench.servo.drive.power
        before = power.state, power.motion, bench.statusword, bench.read(Object.ERROR_CODE, "H")
        if way == "RPDO":
            bench.receive(Frame(0x201, pack("<Hh", word, 0)))
        else:
            assert bench.write(Object.CONTROLWORD, "H", word) is None
        command = command_in(word, WAY_TO[state][-1])
        target = ARROWS.get((state, command)) if command else None
        shown = state_of(bench.read(Object.STATUSWORD, "H"))
        if target is not None:
            assert shown is target, f"{state.value}: {word:02X}h is {command}"
        else:
            after = power.state, power.motion, bench.statusword, bench.read(Object.ERROR_CODE, "H")
            assert (shown, after) == (state, before), f"{state.value}: {word:02X}h is no arrow"


@pytest.mark.parametrize("state", list(WAY_TO))
def test_bits_of_modes_and_of_makers_are_no_commands(state: State) -> None:
    bench = bench_in(state)
    held = WAY_TO[state][-1]
    for bit in (4, 5, 6, 8, 9, 10, 11, 15):
        bench.rpdo(held | 1 << bit)
        bench.rpdo(held)
        assert bench.state is state


def test_a_fault_reset_is_an_edge() -> None:
    bench = bench_in(FAULT)
    bench.rpdo(0x80)
    assert bench.shows(DISABLED)
    bench.servo.drive.fail(0x3210, ErrorRegister.VOLTAGE)
    bench.rpdo(0x80)
    bench.rpdo(0x86)
    assert bench.shows(FAULT), "bit 7 stayed"
    bench.rpdo(0x06)
    bench.rpdo(0x86)
    assert bench.shows(DISABLED)
    bench.rpdo(0x06)
    assert bench.shows(READY)


def test_arrow_16_is_closed_where_the_quick_stop_does_not_stay() -> None:
    bench = bench_in(ENABLED)
    assert bench.write(Object.QUICK_STOP_OPTION, "h", 2) is None
    bench.rpdo(0x0F, 800)
    bench.wait_ms(50)
    bench.rpdo(0x02)
    bench.rpdo(0x0F)
    assert bench.shows(STOP)
    bench.wait_until(lambda: bench.shows(DISABLED), 400)


def test_a_refused_or_malformed_controlword_changes_nothing() -> None:
    bench = bench_in(ENABLED)
    bench.receive(Frame(0x201, b"\x00"))  # too short for the mapping: an EMCY, no controlword
    assert bench.write(Object.CONTROLWORD, "I", 0) is not None
    assert bench.write(Object.STATUSWORD, "H", 0) is not None
    assert bench.shows(ENABLED)
