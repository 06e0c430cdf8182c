"""Options of ``hil measure`` that cannot be used are named, and nothing is started."""

from pathlib import Path

import pytest

from tests.scenario.test_measure import typed


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--node", "200"], "--node"),
        (["--node", "unconfigured"], "--node"),
        (["--node", "1", "--motor", "nowhere.toml"], "--motor"),
        (["--node", "1", "--faults", "nowhere.toml"], "--faults"),
        (["--node", "1", "--out", "/nowhere/network.toml"], "--out"),
        (["--node", "1", "--picture", "stages.gif"], "--picture"),
        (["--node", "1", "--bus", "hub:none", "--motor", "MOTOR"], "--motor"),
    ],
)
def test_bad_input_is_named(options: list[str], named: str) -> None:
    motor = Path(__file__).parents[2] / "examples" / "motors" / "ling2012.toml"
    status, text, said = typed(*[str(motor) if option == "MOTOR" else option for option in options])
    assert status == 2
    assert text == ""
    assert named in said
    assert "Traceback" not in said
