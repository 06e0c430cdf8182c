"""``hil simulate --export-eds``: the drive's EDS, read by python canopen and held against the drive."""

import configparser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.sdo.exceptions import SdoAbortedError

from tests.scenario.processes import hub_name, simulated_drive

NODE = 1
NO_OBJECT = 0x0602_0000
STATUSWORD = 0x6041
"""Its value at power-on is that of a state."""
ERROR_HISTORY = 0x1003
"""Without an error its entries have no data (CiA 301, 7.5.2.4)."""
SEARCHED = (range(0x1000, 0x1030), range(0x1200, 0x1203), range(0x20FE, 0x2112), range(0x6000, 0x6110))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Any]]:
    path = tmp_path_factory.mktemp("sheet") / "drive.eds"
    bus = hub_name("export")
    with simulated_drive(bus, "--export-eds", str(path)):
        network: Any = canopen.Network()
        network.connect(interface="hub", channel=bus.removeprefix("hub:"), bitrate=1_000_000)
        try:
            node = network.add_node(NODE, str(path))
            node.sdo.RESPONSE_TIMEOUT = 20.0
            yield path, node
        finally:
            network.disconnect()


def test_every_object_of_the_sheet_is_there_and_has_its_default(drive: tuple[Path, Any]) -> None:
    _, node = drive
    differ, seen = [], 0
    for entry in node.object_dictionary.values():
        if entry.index < 0x1000:
            continue
        members = [entry] if isinstance(entry, canopen.objectdictionary.ODVariable) else entry.values()
        for member in members:
            seen += 1
            if member.index == ERROR_HISTORY and member.subindex:
                continue
            raw = node.sdo.upload(member.index, member.subindex)
            value = member.default
            wanted = None if value is None else member.encode_raw(value)
            if wanted is not None and wanted != raw and member.index != STATUSWORD:
                differ.append((f"{member.index:04X}h:{member.subindex}", raw.hex(), wanted.hex()))
    assert differ == []
    assert seen > 250


def test_no_other_object_is_there(drive: tuple[Path, Any]) -> None:
    _, node = drive
    for index in (index for indices in SEARCHED for index in indices):
        if index not in node.object_dictionary:
            with pytest.raises(SdoAbortedError) as refused:
                node.sdo.upload(index, 0)
            assert refused.value.code == NO_OBJECT


def test_the_drive_stores_the_same_sheet(drive: tuple[Path, Any]) -> None:
    """CiA 301, 7.5.2.23 and 7.5.2.24: 1021h, and 1022h = 0, uncompressed."""
    path, node = drive
    assert node.sdo.upload(0x1021, 0) == path.read_bytes()
    assert node.sdo.upload(0x1022, 0) == b"\x00\x00"


def test_device_info_is_the_identity_of_1018h(drive: tuple[Path, Any]) -> None:
    """CiA 306-1, DeviceInfo."""
    path, node = drive
    sheet = configparser.RawConfigParser()
    sheet.read(path, encoding="latin-1")
    info = sheet["DeviceInfo"]
    for subindex, key in enumerate(("VendorNumber", "ProductNumber", "RevisionNumber"), 1):
        assert int(info[key], 16) == int.from_bytes(node.sdo.upload(0x1018, subindex), "little")
    assert info["LSS_Supported"] == "1"
    assert int(info["NrOfRXPDO"]) == int(info["NrOfTXPDO"]) == 4
    assert not sheet.has_option("1018sub4", "DefaultValue"), "the serial number is each drive's own"
