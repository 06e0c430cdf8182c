"""Data sheet and memory of a simulated device, as the command line names them."""

from pathlib import Path

import pytest

from drivers.errors import BadInput
from hil.device_files import DeviceFiles


def test_without_files_there_is_nothing_to_lay_over_or_to_keep() -> None:
    assert DeviceFiles().vendor(print) is None
    assert DeviceFiles().memory([1, 2]) is None


def test_missing_data_sheet_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"missing\.eds"):
        DeviceFiles(eds=tmp_path / "missing.eds").vendor(print)


def test_one_memory_is_not_shared(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="one --node"):
        DeviceFiles(store=tmp_path / "memory.json").memory([1, 2])


def test_foreign_file_is_no_memory(tmp_path: Path) -> None:
    (tmp_path / "memory.json").write_text("[]")
    with pytest.raises(BadInput, match="stored parameters"):
        DeviceFiles(store=tmp_path / "memory.json").memory([1])


def test_repairs_of_the_data_sheet_are_told(tmp_path: Path) -> None:
    eds = tmp_path / "torn.eds"
    eds.write_text("[2000]\nParameterName=A\nObjectType=0x7\nDataType=0x0005\nDefaultValue=1\n")
    said: list[str] = []
    assert DeviceFiles(eds=eds).vendor(said.append) is not None
    assert any("AccessType is missing" in line for line in said)
