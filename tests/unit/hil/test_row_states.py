"""States that follow from the records."""

import numpy as np
import pytest

from servobench.drivers.exchange import NEVER_TOLD
from servobench.hil.loop.cycle_record import FATE_MISSED
from servobench.hil.rows.records import (
    LINK_DOWN_CYCLES,
    DriveStates,
    HostStates,
    LabelChange,
    LinkStates,
    drive_label,
)
from tests.unit.hil.row_tools import plain_rows

ENABLED, READY, FAULT = 0x0627, 0x0621, 0x0608


def test_drive_states_change_with_the_statusword_and_only_with_its_state_bits() -> None:
    words = [READY, READY | 0x1000, ENABLED, ENABLED, FAULT]
    rows = plain_rows(5, statusword=words)
    rows["status_told_at"] = rows["due_at"] + 300_000
    rows["status_told_at"][4] = NEVER_TOLD
    assert DriveStates().changes(rows) == [
        LabelChange(300_000, "Ready to switch on"),
        LabelChange(2_300_000, "Operation enabled"),
        LabelChange(4_000_000, "Fault"),
    ]


def test_a_dropout_says_nothing_about_the_drive() -> None:
    rows = plain_rows(3, statusword=[ENABLED, 0, ENABLED], fate=[0, 1, 0])
    assert [change.label for change in DriveStates().changes(rows)] == ["Operation enabled"]


def test_an_undefined_statusword_is_named() -> None:
    assert drive_label(0x0F) == "Fault reaction active"
    assert drive_label(0x02) == "undefined 0x02"


def test_link_goes_down_and_comes_back() -> None:
    fate = [0] * 30 + [1] * 25 + [0] * 1040
    labels = [(c.at // 1_000_000, c.label) for c in LinkStates().changes(plain_rows(1095, fate=fate))]
    assert labels == [(0, "OK"), (30, "DEGRADED"), (49, "DOWN"), (55, "DEGRADED"), (1054, "OK")]


def test_a_link_that_loses_two_percent_is_never_ok() -> None:
    drawn = np.random.default_rng(41).random(20_000) < 0.02
    labels = [change.label for change in LinkStates().changes(plain_rows(drawn.size, fate=drawn.astype(int)))]
    assert labels == ["OK", "DEGRADED"]


def test_cycles_without_sync_are_the_hosts_and_not_the_links() -> None:
    rows = plain_rows(95, fate=[0] * 30 + [FATE_MISSED] * 25 + [0] * 40)
    assert [change.label for change in LinkStates().changes(rows)] == ["OK"]
    labels = [(c.at // 1_000_000, c.label) for c in HostStates().changes(rows)]
    assert labels == [(0, "In time"), (30, "MISSED"), (55, "In time")]


@pytest.mark.parametrize("cuts", [[1], [7, 33, 34, 35], [LINK_DOWN_CYCLES, 60]])
def test_division_into_chunks_does_not_matter(cuts: list[int]) -> None:
    fate = [0] * 30 + [1] * 23 + [FATE_MISSED] * 2 + [0] * 40
    rows = plain_rows(95, fate=fate, statusword=[READY] * 40 + [ENABLED] * 55)
    for states in (LinkStates, DriveStates, HostStates):
        parts, whole = states(), states()
        found = [change for part in np.split(rows, cuts) for change in parts.changes(part)]
        assert found == whole.changes(rows)
