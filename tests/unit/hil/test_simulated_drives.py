"""The drives that a bench makes for its own bus, as its file says."""

from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.canopen.nmt_states import UNCONFIGURED
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.simulated_drives import ids_on_the_bus, serial_of_each, simulated_drives
from servobench.virtual_bus.device.lss_slave import NODE_ID_KEY
from servobench.virtual_bus.device.parameter_storage import FileStore
from tests.unit.hil.test_config import EXAMPLES, edited


def bench_lacking(lacks: list[Any]) -> BenchConfig:
    raw = edited("drive", "axis1", "simulation", "lacks", value=lacks)
    return bench_from(raw, "bench.toml", Path(EXAMPLES))


def test_a_drive_does_without_what_its_table_says() -> None:
    (drive,) = simulated_drives(bench_lacking(["1013", "1400:5"]))
    assert drive.dictionary.get(0x1013) is None
    assert drive.dictionary.get(0x1400, 5) is None
    assert drive.dictionary.get(0x6074) is not None


@pytest.mark.parametrize("lack", ["606", "0x1013", "1400.5", "pdo events"])
def test_what_is_no_object_is_refused_with_the_file(lack: str) -> None:
    with pytest.raises(BadInput) as caught:
        bench_lacking([lack])
    assert caught.value.key == "drive.axis1.simulation.lacks[0]"
    assert caught.value.value == lack


def test_an_object_that_the_drive_has_not_is_refused_before_anything_is_opened() -> None:
    with pytest.raises(BadInput) as caught:
        simulated_drives(bench_lacking(["5FFF"]))
    assert (caught.value.source, caught.value.key) == ("bench.toml", "drive.axis1.simulation.lacks")
    assert caught.value.value == "5FFF"


def test_the_id_that_lss_has_stored_is_the_one_to_be_looked_for(tmp_path: Path) -> None:
    store = FileStore(tmp_path / "memory.json")
    assert ids_on_the_bus([1, 2], None) == [1, 2]
    assert ids_on_the_bus([UNCONFIGURED], store) == [UNCONFIGURED]
    store.save({NODE_ID_KEY: bytes([7])})
    assert ids_on_the_bus([UNCONFIGURED], store) == [7]


def test_no_two_nodes_without_id_have_one_identity() -> None:
    """CiA 305: the LSS address, vendor to serial number, is a device's alone."""
    assert serial_of_each([1, UNCONFIGURED], []) == [None, None]
    assert serial_of_each([UNCONFIGURED, 1, UNCONFIGURED], []) == [255, None, 256]
    assert serial_of_each([UNCONFIGURED] * 2, [9, 4]) == [9, 4]
