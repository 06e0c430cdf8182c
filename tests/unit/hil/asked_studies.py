"""The studies of speed loops replaced: they keep what they were asked, and say who answers."""

from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from servobench.design.errors import DesignError
from servobench.hil.cli import app
from servobench.hil.configuration.motor_file import LING2012
from tests.told import ROOT

MOTOR = LING2012.parameters
FILE = str(ROOT / "examples" / "motors" / "ling2012.toml")
SIMULATED = "the simulated drive, as nothing else is said"
RATED = MOTOR.rated_torque_nm, MOTOR.rated_speed_rad_s


def hil(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(each) for each in arguments])


def refusal(result: Result) -> str:
    assert (result.exit_code, result.stdout) == (2, "")
    return result.stderr.removeprefix("hil: error: ").rstrip("\n")


class Studies:
    """What was asked; each answer says whose it is."""

    def __init__(self) -> None:
        self.asked: dict[str, Any] = {}
        self.fails: DesignError | None = None

    def answering(self, name: str) -> Any:
        def answer(*given: Any) -> Any:
            self.asked[name] = given
            if self.fails is not None:
                raise self.fails
            return {name: "told"}

        return answer
