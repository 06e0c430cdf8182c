"""What this machine has: CAN interfaces as iproute2 tells them, USB serial ports as pyserial does."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers.wire.attached import CanLink, can_links, parse_links, serial_adapters

DESCRIBED = json.dumps(
    [
        {"ifname": "lo", "link_type": "loopback", "flags": ["UP"]},
        {
            "ifname": "can0",
            "link_type": "can",
            "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
            "linkinfo": {
                "info_kind": "can",
                "info_data": {
                    "state": "ERROR-PASSIVE",
                    "berr_counter": {"tx": 128, "rx": 3},
                    "ctrlmode": ["LISTEN-ONLY"],
                    "bittiming": {"bitrate": 500000, "sample_point": "0.875"},
                },
            },
        },
        {
            "ifname": "can1",
            "link_type": "can",
            "flags": ["NOARP", "ECHO"],
            "linkinfo": {"info_kind": "can", "info_data": {"state": "STOPPED"}},
        },
        {"ifname": "vcan0", "link_type": "can", "flags": ["NOARP", "UP"], "linkinfo": {"info_kind": "vcan"}},
    ]
)


def test_links_are_read_with_rate_state_and_counters() -> None:
    assert parse_links(DESCRIBED) == [
        CanLink("can0", True, "can", 500_000, "ERROR-PASSIVE", 128, 3, True),
        CanLink("can1", False, "can", None, "STOPPED"),
        CanLink("vcan0", True, "vcan", None, ""),
    ]


@pytest.mark.parametrize("text", ["", "  ", "Object is not there", "{}", "[3]", '[{"link_type": "ether"}]'])
def test_what_is_no_description_has_no_links(text: str) -> None:
    assert parse_links(text) == []


def test_links_are_found_without_iproute2_too(tmp_path: Path) -> None:
    link = tmp_path / "can7"
    link.mkdir()
    (link / "type").write_text("280\n")
    (link / "flags").write_text("0x40041\n")
    assert can_links(tmp_path, "") == [CanLink("can7", True, "", None, "")]
    both = can_links(tmp_path, DESCRIBED)
    assert [one.name for one in both] == ["can0", "can1", "can7", "vcan0"]
    assert both[0].spec == "socketcan:can0"


def test_usb_serial_ports_are_listed_with_what_they_may_be(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    device = tmp_path / "ttyACM0"
    device.write_text("")
    ports = [
        SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, description="n/a", serial_number=None),
        SimpleNamespace(
            device=str(device), vid=0x16D0, pid=0x117E, description="CANable", serial_number="0042"
        ),
        SimpleNamespace(device="/dev/ttyUSB9", vid=0x0403, pid=0x6001, description="n/a", serial_number=None),
    ]
    monkeypatch.setattr("drivers.wire.attached.list_ports.comports", lambda: ports)
    unknown, canable = serial_adapters()
    assert unknown.spec == "slcan:/dev/ttyUSB9"
    assert (unknown.usb_id, unknown.hint, unknown.description) == ("0403:6001", "", "")
    assert not unknown.permitted
    assert canable.usb_id == "16d0:117e"
    assert "CANable" in canable.hint
    assert canable.permitted
