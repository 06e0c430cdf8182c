"""``hil commission``, ``restore`` and ``rehearse``: what each hands on, and with which status it ends."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from servobench.hil.cli import app
from servobench.hil.commissioning import commission, rehearsal, restore_command
from servobench.hil.commissioning.request import CommissionRequest, Nameplate, load_nameplate

SEPARATE = {"yes": False, "rehearse": None, "rehearse_eds": None, "plate_given": False}


def hil(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


class Handed:
    """What was handed on, and what is answered."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.status = 0
        self.outcome: dict[str, Any] = {"complete": True, "text": ["one", "two"]}

    def commission(self, request: CommissionRequest, **how: Any) -> tuple[int, dict[str, Any]]:
        self.asked.append((request, how))
        return self.status, {"steps": 7}

    def restore(self, *given: Any) -> dict[str, Any]:
        self.asked.append(given)
        return self.outcome

    def rehearse(self, *, announce: Any, **how: Any) -> None:
        announce("it turns")
        self.asked.append(how)


@pytest.fixture
def handed(monkeypatch: pytest.MonkeyPatch) -> Handed:
    made = Handed()
    monkeypatch.setattr(commission, "run_command", made.commission)
    monkeypatch.setattr(restore_command, "run_restore", made.restore)
    monkeypatch.setattr(rehearsal, "rehearse", made.rehearse)
    return made


def test_a_commissioning_is_asked_for_with_what_holds_without_options(handed: Handed) -> None:
    told = hil("commission", "--bus", "hub:x", "--node", "3", "--out", "there")
    assert (told.exit_code, told.stdout, told.stderr) == (0, "", "")
    request = CommissionRequest(
        bus="hub:x", node=3, out=Path("there"), eds=None, nameplate=Nameplate(), bitrate_bit_s=1_000_000,
        period_us=None, dry_run=False, store=False, trust_nameplate=False, heartbeat_timeout_ms=150,
        unwatched=False,
    )  # fmt: skip
    assert handed.asked == [(request, SEPARATE)]


def test_the_options_of_a_commissioning_are_its_request(handed: Handed, tmp_path: Path) -> None:
    plate = tmp_path / "plate.toml"
    plate.write_text("[rating]\ntorque_nm = 1.25\n")
    handed.status = 1
    told = hil(
        "commission", "--bus", "simulated", "--node", "3", "--out", "there", "--eds", "a.eds", "--motor",
        plate, "--yes", "--dry-run", "--store", "--period-us", "2000", "--heartbeat-timeout-ms", "80",
        "--unwatched", "--bitrate", "500000", "--rehearse", "5", "--rehearse-eds", "b.eds",
        "--trust-nameplate", "--json",
    )  # fmt: skip
    assert (told.exit_code, json.loads(told.stdout)) == (1, {"steps": 7})
    request = CommissionRequest(
        bus="simulated", node=3, out=Path("there"), eds=Path("a.eds"), nameplate=load_nameplate(plate),
        bitrate_bit_s=500_000, period_us=2000, dry_run=True, store=True, trust_nameplate=True,
        heartbeat_timeout_ms=80, unwatched=True,
    )  # fmt: skip
    how = {"yes": True, "rehearse": 5, "rehearse_eds": Path("b.eds"), "plate_given": True}
    assert handed.asked == [(request, how)]


def test_what_was_changed_is_put_back_by_its_journal(handed: Handed) -> None:
    told = hil("restore", "journal.jsonl")
    assert (told.exit_code, told.stdout, told.stderr) == (0, "", "one\ntwo\n")
    handed.outcome["complete"] = False
    told = hil("restore", "journal.jsonl", "--bus", "hub:x", "--store", "--json")
    assert (told.exit_code, json.loads(told.stdout), told.stderr) == (1, handed.outcome, "")
    journal = Path("journal.jsonl")
    assert handed.asked == [(journal, None, False), (journal, "hub:x", True)]


def test_an_unknown_drive_is_simulated_as_it_is_asked_for(handed: Handed) -> None:
    told = hil("rehearse", "--bus", "hub:x", "--node", "4", "--seed", "9")
    assert (told.exit_code, told.stdout, told.stderr) == (0, "", "it turns\n")
    plain = {
        "bus_spec": "hub:x", "node": 4, "seed": 9, "nameplate": None, "truth_file": None, "faults": None,
        "clock_drift_ppm": 0.0, "bitrate_bit_s": 1_000_000,
    }  # fmt: skip
    hil(
        "rehearse", "--bus", "hub:x", "--node", "4", "--seed", "9", "--nameplate", "plate.toml", "--truth",
        "truth.toml", "--drift-ppm", "-20", "--bitrate", "250000",
    )  # fmt: skip
    assert handed.asked == [
        plain,
        plain
        | {
            "nameplate": Path("plate.toml"), "truth_file": Path("truth.toml"), "clock_drift_ppm": -20.0,
            "bitrate_bit_s": 250_000,
        },
    ]  # fmt: skip
