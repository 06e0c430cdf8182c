"""Bus specifications and the errors of opening a bus."""

import errno
from contextlib import suppress
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.wire import adapters
from servobench.drivers.wire.adapters import (
    BusSpec,
    known_interfaces,
    link_up_command,
    open_bus,
    parse_bus_spec,
    socketcan_links,
)
from servobench.drivers.wire.link import StampSource
from tests.draws import examples_of


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("simulated", BusSpec("simulated")),
        ("hub:bench", BusSpec("hub", "bench")),
        ("socketcan:vcan0", BusSpec("socketcan", "vcan0")),
        ("pcan:PCAN_USBBUS1", BusSpec("pcan", "PCAN_USBBUS1")),
        ("slcan:/dev/ttyACM0", BusSpec("slcan", "/dev/ttyACM0")),
        ("slcan:/dev/ttyACM0@115200", BusSpec("slcan", "/dev/ttyACM0", 115200)),
        ("slcan:socket://127.0.0.1:2000", BusSpec("slcan", "socket://127.0.0.1:2000")),
    ],
)
def test_specifications_are_parsed_and_named_alike(text: str, spec: BusSpec) -> None:
    assert parse_bus_spec(text) == spec
    assert str(spec) == text


@pytest.mark.parametrize(
    ("text", "telling"),
    [
        ("sockecan:vcan0", "did you mean 'socketcan'"),
        ("vcan0", "did you mean 'socketcan:vcan0'"),
        ("can12", "did you mean 'socketcan:can12'"),
        ("nonsense", "known are"),
        ("", "INTERFACE"),
        ("hub", "hub:bench"),
        ("socketcan:", "socketcan:can0"),
        ("simulated:x", "without a channel"),
        ("slcan:/dev/ttyACM0@fast", "line speed in baud"),
        ("slcan:/dev/ttyACM0@0", "line speed in baud"),
        ("udp_multicast:239.0.0.1", "INTERFACE"),
    ],
)
def test_bad_specifications_name_source_key_and_remedy(text: str, telling: str) -> None:
    with pytest.raises(BadInput, match=r"bench\.toml: bus\.spec") as caught:
        parse_bus_spec(text, "bench.toml", "bus.spec")
    assert telling in str(caught.value)


@examples_of(100)
@given(st.text(max_size=30))
def test_no_text_is_anything_but_a_spec_or_bad_input(text: str) -> None:
    with suppress(BadInput):
        assert parse_bus_spec(text).interface in known_interfaces()


def test_the_simulated_bus_is_not_opened_here() -> None:
    with pytest.raises(BadInput, match="hub:NAME"):
        open_bus(BusSpec("simulated"), 1_000_000)


def test_a_virtual_bus_is_opened_with_wall_clock_stamps() -> None:
    opened = open_bus(parse_bus_spec("virtual:adapter-test"), 1_000_000)
    try:
        assert opened.stamps is StampSource.WALL_CLOCK
        assert opened.name == "virtual:adapter-test"
    finally:
        opened.bus.shutdown()


def test_a_missing_serial_port_says_what_to_check() -> None:
    with pytest.raises(BusDown, match=r"cannot open slcan:/dev/no-such-port@115200.*dialout"):
        open_bus(parse_bus_spec("slcan:/dev/no-such-port@115200"), 500_000)


def link(root: Path, name: str, kind: str, flags: str) -> None:
    (root / name).mkdir()
    (root / name / "type").write_text(f"{kind}\n")
    (root / name / "flags").write_text(f"{flags}\n")


def test_socketcan_links_are_listed_with_their_state(tmp_path: Path) -> None:
    link(tmp_path, "can0", "280", "0x40080")
    link(tmp_path, "vcan0", "280", "0x400c1")
    link(tmp_path, "eth0", "1", "0x1003")
    down, up = socketcan_links(tmp_path)
    assert (down.spec, down.usable) == ("socketcan:can0", False)
    assert "ip link set can0 up type can bitrate 1000000" in down.description
    assert (up.spec, up.usable) == ("socketcan:vcan0", True)
    assert socketcan_links(tmp_path / "none") == []


def test_an_interface_that_is_down_names_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link(tmp_path, "can0", "280", "0x40080")
    link(tmp_path, "eth0", "1", "0x1003")
    monkeypatch.setattr(adapters, "_NETWORK_LINKS", tmp_path)
    with pytest.raises(BusDown, match="can0 is down; ip link set can0 up type can bitrate 250000"):
        open_bus(parse_bus_spec("socketcan:can0"), 250_000)
    with pytest.raises(BusDown, match="eth0 is no CAN interface"):
        open_bus(parse_bus_spec("socketcan:eth0"), 250_000)


def test_a_missing_socketcan_interface_names_a_way_on() -> None:
    with pytest.raises(BusDown, match=r"cannot open socketcan:vcan77.*(hub:NAME|ip link add dev vcan77)"):
        open_bus(parse_bus_spec("socketcan:vcan77"), 1_000_000)


def test_an_adapter_that_is_back_under_another_name_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_options: object) -> None:
        raise OSError(errno.ENODEV, "No such device")

    link(tmp_path, "can1", "280", "0x40081")
    monkeypatch.setattr(adapters, "_NETWORK_LINKS", tmp_path)
    monkeypatch.setattr(adapters, "StampedSocketcanBus", refuse)
    with pytest.raises(BusDown, match=r"No such device; plug it in; there is socketcan:can1 \(hil scan\)"):
        open_bus(parse_bus_spec("socketcan:can0"), 1_000_000)
    with pytest.raises(BusDown, match="ip link add dev vcan0"):
        open_bus(parse_bus_spec("socketcan:vcan0"), 1_000_000)


def test_a_driver_that_is_not_installed_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_options: object) -> None:
        raise NameError("name 'canGetNumberOfChannels' is not defined")

    monkeypatch.setattr(can, "Bus", refuse)
    with pytest.raises(BusDown, match=r"no driver for kvaser:0.*library is not installed"):
        open_bus(parse_bus_spec("kvaser:0"), 1_000_000)


def test_link_up_commands() -> None:
    assert link_up_command("vcan0") == "ip link add dev vcan0 type vcan; ip link set vcan0 up"
