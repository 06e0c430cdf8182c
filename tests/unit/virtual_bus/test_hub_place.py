"""The files of a hub: who holds a lock is alone, also where the last holder has removed it."""

import fcntl
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from servobench.virtual_bus.bus.hub_place import try_lock

TIMES_EACH = 100


def test_a_lock_whose_holders_remove_it_keeps_all_others_out(tmp_path: Path) -> None:
    path = tmp_path / "x.lock"
    holders: list[int] = []
    crowded: list[int] = []

    def hold(number: int) -> None:
        held = 0
        while held < TIMES_EACH:
            descriptor = try_lock(path)
            if descriptor is None:
                os.sched_yield()
                continue
            holders.append(number)
            os.sched_yield()
            crowded.extend(holders[1:])
            holders.remove(number)
            path.unlink()  # from here on another may hold it
            os.close(descriptor)
            held += 1

    with ThreadPoolExecutor(4) as at_work:
        list(at_work.map(hold, range(4)))
    assert crowded == []
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_is_removed_between_opening_and_locking_is_taken_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.lock"
    first = try_lock(path)
    assert first is not None
    holders = [first]
    lock = fcntl.flock

    def flock(descriptor: int, operation: int) -> None:
        while holders:
            path.unlink()
            os.close(holders.pop())
        lock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    second = try_lock(path)
    assert second is not None
    assert try_lock(path) is None
    assert os.path.samestat(os.fstat(second), path.stat())
    os.close(second)
