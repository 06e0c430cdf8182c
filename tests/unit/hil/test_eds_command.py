"""``hil eds`` as a user types it."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.cia402.profile import BENCH_RULE
from servobench.hil.cli import app
from tests.unit.drivers.eds_maker import four_pdos, sheet_text

LIMITS = Path(__file__).parents[3] / "docs" / "limits.md"


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["eds", *arguments])
    return result.exit_code, result.stdout


def told(*arguments: str) -> dict[str, Any]:
    status, text = run(*arguments, "--json")
    found: dict[str, Any] = json.loads(text)
    assert found["serves"] == (status == 0)
    return found


@pytest.fixture
def good(tmp_path: Path) -> str:
    path = tmp_path / "good.eds"
    path.write_text(sheet_text(four_pdos()))
    return str(path)


@pytest.fixture
def bad(tmp_path: Path) -> str:
    path = tmp_path / "bad.eds"
    path.write_text(sheet_text(four_pdos(), device_type="0x00030191", without=(0x6040,)))
    return str(path)


def test_a_drive_that_serves(good: str) -> None:
    status, text = run(good)
    assert status == 0
    for words in (
        "Maker",
        "CiA 402",
        "cyclic synchronous torque, by 6502h",
        "TPDO1  181h",
        "1016h",
        "1 repair",
    ):
        assert words in text
    assert (
        'It can serve a bench, best in cyclic synchronous torque; `hil run` can use it with mode = "cst"'
        in text
    )


def test_a_drive_without_the_mode_of_hil_run_says_so(tmp_path: Path) -> None:
    path = tmp_path / "velocity.eds"
    path.write_text(sheet_text(four_pdos(), modes="0x104"))
    status, text = run(str(path))
    assert status == 0
    assert 'best in cyclic synchronous velocity; `hil run` can use it with mode = "csv".' in text


def test_a_drive_that_hil_run_cannot_use_is_told_in_the_words_of_the_docs(tmp_path: Path) -> None:
    path = tmp_path / "profile.eds"
    path.write_text(sheet_text(four_pdos(), modes="0x4"))
    status, text = run(str(path))
    assert status == 0
    assert f"best in profile velocity; {BENCH_RULE}." in text
    assert BENCH_RULE in LIMITS.read_text()


def test_a_device_that_does_not_says_why(bad: str) -> None:
    status, text = run(bad)
    assert status == 1
    assert "It cannot serve a bench:" in text
    assert "device profile 401 (0191h)" in text
    assert "6040h:00 missing" in text


def test_json_is_one_object_with_everything(bad: str, good: str) -> None:
    found = told(good)
    assert found["profile"] == 402
    assert found["identity"]["vendor_id"] == "0x00000123"
    assert found["pdos"][0]["cob_id"] == "0x181"
    assert found["repairs"][0]["fault"] == "the lists of objects are missing"
    assert {lack["index"]: lack["name"] for lack in found["missing"]}["1016h"] == "consumer heartbeat time"
    assert found["obstacles"] == []
    assert len(told(bad)["obstacles"]) == 2


def test_the_plan_and_its_budget(good: str) -> None:
    status, text = run(good, "--plan", "--bitrate", "500000", "--period-us", "2000")
    assert status == 0
    assert "PDO plan for cyclic synchronous torque" in text
    assert "734 us of 2000 us at 500 kbit/s: 36.7 % of the bus" in text
    plan = told(good, "--mode", "pv")["plan"]
    assert plan["mode"] == "profile velocity"
    assert plan["pdos"][-1]["mapping"] == ["6040h:00/16", "60FFh:00/32"]
    assert plan["budget"]["load_percent"] == pytest.approx(38.34)


def test_units_as_far_as_the_file_tells_them(tmp_path: Path) -> None:
    path = tmp_path / "x.eds"
    words = "".join(
        f"[{index:04X}]\nParameterName=x\nDataType=7\nAccessType=rw\nDefaultValue={value}\n"
        for index, value in ((0x6076, 2000), (0x60A9, 0x00B44700))
    )
    path.write_text(sheet_text(four_pdos(), also=words))
    units = {line["name"]: line for line in told(str(path))["units"]}
    assert units["torque"]["value"] == pytest.approx(0.002)
    assert units["velocity"]["value"] == pytest.approx(0.10471976)
    assert units["position"] == {"name": "position", "value": None, "unit": "rad", "source": "not told"}
    assert units["acceleration"]["value"] is None


def test_a_plan_that_is_impossible_says_why(tmp_path: Path) -> None:
    path = tmp_path / "x.eds"
    path.write_text(sheet_text(four_pdos(), without=(0x6071,)))
    plan = told(str(path), "--mode", "cst")["plan"]
    assert (plan["possible"], "6071h:00" in plan["reason"]) == (False, True)
    assert "none: 6071h:00 is not in the dictionary" in run(str(path), "--mode", "cst")[1]


def test_node_ids(good: str, tmp_path: Path) -> None:
    assert told(good, "--node", "9")["pdos"][0]["cob_id"] == "0x189"
    dcf = tmp_path / "x.dcf"
    dcf.write_text(
        sheet_text(four_pdos(), also="[DeviceComissioning]\nNodeID=7\nNodeName=axis\nBaudrate=500\n")
    )
    found = told(str(dcf))
    assert (found["kind"], found["node_id"], found["pdos"][0]["cob_id"]) == ("DCF", 7, "0x187")
    assert "node 7, axis, 500 kbit/s" in run(str(dcf))[1]


@pytest.mark.parametrize("content", ["", "not a data sheet", "<?xml version='1.0'?>"])
def test_what_cannot_be_read_is_status_2(tmp_path: Path, content: str) -> None:
    path = tmp_path / "x.eds"
    path.write_text(content)
    status, text = run(str(path), "--json")
    assert (status, text) == (2, "")
    assert run(str(tmp_path / "missing.eds"))[0] == 2
