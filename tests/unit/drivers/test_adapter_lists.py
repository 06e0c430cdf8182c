"""What this machine has: CAN interfaces as iproute2 tells them, USB serial ports as pyserial does."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servobench.drivers.wire.attached import CanLink, can_links, link_advice, parse_links, serial_adapters

DESCRIBED = json.dumps(
    [
        {"ifname": "lo", "link_type": "loopback", "flags": ["UP"]},
        {
            "ifname": "can0",
            "link_type": "can",
            "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
            "txqlen": 10,
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
        CanLink("can0", True, "can", 500_000, "ERROR-PASSIVE", 128, 3, True, 10, 0, 0.875),
        CanLink("can1", False, "can", None, "STOPPED", restart_ms=0),
        CanLink("vcan0", True, "vcan", None, ""),
    ]


def test_a_driver_that_knows_a_few_bit_rates_tells_its_own_elsewhere() -> None:
    """As iproute2 6.1 prints Linux's driver of serial adapters, shortened."""
    described = (
        '[{"ifname": "can0", "flags": ["NOARP", "UP", "LOWER_UP"], "txqlen": 10, "link_type": "can", '
        '"linkinfo": {"info_kind": "can", "info_data": {"state": "ERROR-ACTIVE", "restart_ms": 0, '
        '"bittiming_bitrate": 500000, "bitrate_const": [500000, 1000000], "clock": 0}}}]'
    )
    (link,) = parse_links(described)
    assert (link.bitrate_bit_s, link.sample_point) == (500_000, None)
    assert "can0 is set to 500000 bit/s, the bench to 1000000" in "\n".join(link_advice(link, 1_000_000))
    assert link_advice(link, 500_000) == [], "the driver has no restart-ms"


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
    monkeypatch.setattr("servobench.drivers.wire.attached.list_ports.comports", lambda: ports)
    unknown, canable = serial_adapters()
    assert unknown.spec == "slcan:/dev/ttyUSB9"
    assert (unknown.usb_id, unknown.hint, unknown.description) == ("0403:6001", "", "")
    assert not unknown.permitted
    assert canable.usb_id == "16d0:117e"
    assert "CANable" in canable.hint
    assert canable.permitted


SOUND = CanLink(
    "can0", True, "can", 500_000, "ERROR-ACTIVE", queue_length=10, restart_ms=100, sample_point=0.875
)


@pytest.mark.parametrize(
    ("changed", "bitrate", "advice"),
    [
        ({}, 500_000, ""),
        ({}, None, ""),
        ({"kind": "vcan", "restart_ms": 0, "queue_length": 1}, 250_000, ""),
        ({"up": False, "restart_ms": 0}, None, ""),
        (
            {},
            1_000_000,
            "set to 500000 bit/s, the bench to 1000000 (bus.bitrate_bit_s): ip link set can0 down;",
        ),
        ({"listen_only": True}, None, "up type can bitrate 500000 listen-only off"),
        ({"state": "BUS-OFF"}, None, "bus-off: ip link set can0 down; ip link set can0 up"),
        ({"restart_ms": 0}, None, "up type can bitrate 500000 restart-ms 100"),
        ({"queue_length": 9}, None, "a queue of 9 frames: ip link set can0 txqueuelen 10"),
        ({"sample_point": 0.8}, None, "at 80 %, CiA 301 has 85 to 90 %"),
        ({"sample_point": 0.75, "bitrate_bit_s": 1_000_000}, None, ""),
        ({"sample_point": 0.7, "bitrate_bit_s": 1_000_000}, 1_000_000, "at 70 %, CiA 301 has 75 to 90 %"),
        ({"queue_length": None, "restart_ms": None, "sample_point": None}, None, ""),
    ],
)
def test_settings_that_do_not_fit_are_named_with_the_command_that_mends_them(
    changed: dict[str, Any], bitrate: int | None, advice: str
) -> None:
    found = link_advice(SOUND._replace(**changed), bitrate)
    assert len(found) == bool(advice)
    assert advice in "".join(found)
