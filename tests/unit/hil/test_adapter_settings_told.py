"""Settings of a kernel's adapter that do not suit a bench: ``hil doctor``, ``hil scan`` and the start of a
run name them, with the command that mends each. PATH has a program of the test's own for ``ip``."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.attached import advice_on
from servobench.hil.cli import app
from servobench.hil.machine import doctor
from servobench.hil.machine.doctor import Machine
from tests.unit.hil.test_doctor import machine

__all__ = ["machine"]

RATE = 1_000_000
AGAIN = "ip link set can0 down; ip link set can0 up type can bitrate"
Setting = Callable[..., None]


@pytest.fixture(name="adapter")
def adapter_of_a_made_up_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Setting:
    """Sets what ``ip`` says of can0, which suits a bench at 1 Mbit/s but for that."""
    place = tmp_path / "bin"
    place.mkdir()
    monkeypatch.setenv("PATH", str(place), prepend=":")

    def setting(*, queue: int = 10, **changed: Any) -> None:
        data = {
            "state": "ERROR-ACTIVE",
            "restart_ms": 100,
            "ctrlmode": [],
            "bittiming": {"bitrate": RATE, "sample_point": "0.875"},
            **changed,
        }
        link = {
            "ifname": "can0",
            "link_type": "can",
            "flags": ["UP"],
            "txqlen": queue,
            "linkinfo": {"info_kind": "can", "info_data": data},
        }
        (place / "ip").write_text(f"#!/bin/sh\ncat <<'END'\n{json.dumps([link])}\nEND\n", encoding="utf-8")
        (place / "ip").chmod(0o755)

    return setting


@pytest.mark.parametrize(
    ("changed", "problem", "cure"),
    [
        ({"queue": 1}, "can0 has a queue of 1 frames", "ip link set can0 txqueuelen 10"),
        (
            {"restart_ms": 0},
            "can0 stays bus-off once it is so (restart-ms 0)",
            f"{AGAIN} {RATE} restart-ms 100",
        ),
        (
            {"bittiming": {"bitrate": RATE, "sample_point": "0.600"}},
            "can0 samples a bit at 60 %, CiA 301 has 75 to 90 %",
            f"{AGAIN} {RATE} sample-point 0.875",
        ),
        ({"ctrlmode": ["LISTEN-ONLY"]}, "can0 only listens", f"{AGAIN} {RATE} listen-only off"),
    ],
    ids=["txqueuelen", "restart-ms", "sample point", "listen-only"],
)
def test_each_setting_is_named_with_the_command_that_mends_it(
    machine: Machine, adapter: Setting, changed: dict[str, Any], problem: str, cure: str
) -> None:
    adapter(**changed)
    look = doctor.interface_settings(machine)
    assert (look.detail, look.remedy) == (problem, f"sudo sh -c '{cure}'")
    assert f"note: {problem}: {cure}" in _scanned()
    assert advice_on(parse_bus_spec("socketcan:can0"), RATE) == [f"{problem}: {cure}"]


def test_another_bit_rate_than_that_of_the_bench_is_named_where_the_bench_is_known(adapter: Setting) -> None:
    adapter(bittiming={"bitrate": 500_000, "sample_point": "0.875"})
    assert advice_on(parse_bus_spec("socketcan:can0"), RATE) == [
        f"can0 is set to 500000 bit/s, the bench to {RATE} (bus.bitrate_bit_s): {AGAIN} {RATE}"
    ]


def test_an_adapter_that_suits_is_not_named(machine: Machine, adapter: Setting) -> None:
    adapter()
    assert not doctor.interface_settings(machine).remedy
    assert "note:" not in _scanned()
    assert advice_on(parse_bus_spec("socketcan:can0"), RATE) == []


def _scanned() -> str:
    return CliRunner().invoke(app, ["scan"], catch_exceptions=False).output
