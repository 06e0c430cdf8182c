"""What a drive says of its fault, on the terminal and for programs, line by line."""

from types import SimpleNamespace
from typing import Any, Final

import pytest

from servobench.drivers.cia402.profile import State
from servobench.hil.inspecting.drive_fault import DriveDiagnosis, _asked

WHOLE: Final = DriveDiagnosis(
    3, "a drive", "fault", True, 0x2310, "continuous over-current", 0x03, ((0x12310, "x"), (0x3210, "y"))
)
BARE: Final = DriveDiagnosis(3, "a drive", "unknown", False, None, "", None, ())


def test_all_of_it_is_told() -> None:
    assert WHOLE.lines() == [
        "node 3: a drive",
        "state: fault",
        "error code 2310h: continuous over-current",
        "error register 03h: generic, current",
        "before: 00012310h: x",
        "before: 00003210h: y",
    ]
    assert WHOLE.as_json() == {
        "node": 3,
        "device": "a drive",
        "state": "fault",
        "in_fault": True,
        "error_code": "0x2310",
        "error": "continuous over-current",
        "error_register": 3,
        "history": [{"entry": "0x00012310", "error": "x"}, {"entry": "0x00003210", "error": "y"}],
        "was_reset": False,
    }


def test_what_a_drive_does_not_tell_is_left_out() -> None:
    assert BARE.lines() == ["node 3: a drive", "state: unknown"]
    told = BARE.as_json()
    assert (told["error_code"], told["error_register"], told["history"]) == (None, None, [])
    reset = DriveDiagnosis(3, "a drive", "switch on disabled", False, None, "", None, (), was_reset=True)
    assert reset.lines()[-1] == "the fault was reset"
    assert reset.as_json()["was_reset"] is True


def asked(held: dict[tuple[int, int], int], state: State | None = State.FAULT) -> DriveDiagnosis:
    """Of a drive that has these objects."""
    drive: Any = SimpleNamespace(
        node_id=3,
        objects=SimpleNamespace(read_if_there=lambda index, sub=0, code="I": held.get((index, sub))),
        control=SimpleNamespace(make=(0, ""), read_state=lambda: state),
    )
    return _asked(drive, "a drive", was_reset=False)


HISTORY: Final = {(0x1003, 0): 2, (0x1003, 1): 0x0001_2310, (0x1003, 2): 0x3210}


@pytest.mark.parametrize(
    ("held", "state", "code"),
    [
        ({(0x603F, 0): 0x7121}, State.FAULT, 0x7121),
        ({(0x603F, 0): 0, **HISTORY}, State.FAULT, 0),
        # without 603Fh the newest of the history is what it fell with, if it is in fault
        (HISTORY, State.FAULT, 0x2310),
        (HISTORY, State.FAULT_REACTION, 0x2310),
        (HISTORY, State.OPERATION_ENABLED, None),
        (HISTORY, None, None),
        ({}, State.FAULT, None),
    ],
)
def test_the_code_is_that_of_603f_or_the_newest(
    held: dict[tuple[int, int], int], state: State | None, code: int | None
) -> None:
    found = asked(held, state)
    assert found.error_code == code
    assert bool(found.error) is (code is not None)
    assert found.in_fault is (state in (State.FAULT, State.FAULT_REACTION))
    assert found.state == ("unknown" if state is None else state.value)
    assert (found.node, found.device, found.was_reset) == (3, "a drive", False)


@pytest.mark.parametrize(("count", "kept"), [(0, 0), (1, 1), (16, 16), (17, 16), (254, 16)])
def test_the_newest_sixteen_of_the_history_are_read(count: int, kept: int) -> None:
    entries = {(0x1003, sub): sub for sub in range(1, 255)}
    found = asked({(0x1003, 0): count, **entries})
    assert [entry for entry, _ in found.history] == list(range(1, kept + 1))


def test_entries_that_are_empty_or_cannot_be_read_are_left_out() -> None:
    found = asked({(0x1003, 0): 4, (0x1003, 1): 7, (0x1003, 3): 0, (0x1003, 4): 9, (0x1001, 0): 0x11})
    assert [entry for entry, _ in found.history] == [7, 9]
    assert found.register == 0x11
