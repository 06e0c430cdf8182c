"""What commands tell, whole: texts, and the files that they leave."""

import csv
import json
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Final
from unittest.mock import patch

import pytest
from typer.testing import CliRunner

from servobench.drivers.cia402.profile import Mode, supported_mode_bit
from servobench.hil.cli import app
from servobench.hil.recorded.commissioning_page import commissioning_page
from servobench.hil.studies.papers import reproduction
from servobench.hil.verdict.verdict import ExitStatus
from tests.commissioning import LOSS, unknown_world
from tests.page_text import page_text
from tests.picture_text import drawn
from tests.told import ROOT, hold

pytestmark = pytest.mark.usefixtures("forked_children")

EXAMPLES: Final = ROOT / "examples"
TOLD: Final = Path(__file__).with_name("told")


def run(*commands: str) -> str:
    """Each as on the command line, from the present folder; all that it says."""
    text = ""
    for command in commands:
        done = CliRunner(env={"COLUMNS": "160"}).invoke(app, command.format(examples=EXAMPLES).split())
        assert done.exit_code != ExitStatus.DEFECT, done.output
        assert done.exception is None or isinstance(done.exception, SystemExit), command
        text += f"$ hil {command}\n{done.output}exit status {done.exit_code}\n\n"
    return text


def files(*names: str) -> str:
    """Texts that a command has left in the present folder."""
    return "".join(f"==== {name}\n{Path(name).read_text(encoding='utf-8')}\n" for name in names)


def commissioned() -> str:
    """All units hidden, in cyclic synchronous torque."""
    told = run("commission --bus simulated --node 1 --rehearse 3 --yes --out out")
    left = (
        "report.md",
        "bench.toml",
        "drive.toml",
        "motor.toml",
        "network.toml",
        "drive.dcf",
        "parameters.txt",
    )
    return told + files(*(f"out/{name}" for name in left)) + page_text(commissioning_page(Path("out")))


def commissioned_by_speeds() -> str:
    """A drive that takes no torques, and finds its turn by homing; one reading in a hundred is lost."""
    only = supported_mode_bit(Mode.CYCLIC_SYNCHRONOUS_VELOCITY) | supported_mode_bit(Mode.HOMING)
    said: list[str] = []
    unknown_world(3, Path("out"), modes=only, faults=LOSS, tell=said.append)
    return "\n".join(said) + "\n" + files("out/report.md", "out/drive.toml")


def measured() -> str:
    """A network with faults, drives enabled."""
    told = run(
        "measure --bus simulated --node 1,2 --cycles 800 --enable --seed 3 "
        "--faults {examples}/faults/demo.toml --out network.toml --faults-out faults.toml",
        "measure --bus simulated --node 1 --cycles 300",
    )
    return told + files("network.toml", "faults.toml")


def reviewed() -> str:
    """A run, and what can be asked of its recording."""
    told = run(
        "run {examples}/ling2012.toml --record one",
        "run {examples}/ling2012.toml --record two --seed 7",
        "review one",
        "compare one two",
        "compare one two --json",
        "compare one two --rrd both.rrd",
        "runs .",
        "export one --to csv --out one.csv",
    )
    told += "\n".join(run("trace one").splitlines()[:400:4]) + "\n"
    told += page_text(Path("one/run.rrd")) + page_text(Path("both.rrd"))
    with drawn() as pictures:
        told += run("picture one one.svg --paper", "picture one part.png --paper --at 1 --span 0.2")
    told += "".join(pictures)
    rows = csv.DictReader(Path("one.csv").read_text(encoding="utf-8").splitlines())
    return told + "\n".join(str({**row, "compute_ns": ""}) for row in islice(rows, 0, 200, 20))


SWEEP: Final = """
[campaign]
name = "small"
bench = "{examples}/ling2012.toml"
seeds = 3
failures_recorded = 1

[change]
"bench.duration_s" = 1.2

[[vary]]
key = "drive.axis1.controller.proportional_nm_s_rad"
values = [0.004, 0.12]

[[vary]]
key = "loop.actuation"
values = ["on_arrival", "on_sync"]

[[draw]]
key = "drive.axis1.motor.mechanics.inertia_kg_m2"
distribution = "uniform"
low = 0.0006
high = 0.0010
"""


def campaigned() -> str:
    """A sweep over two keys, half of whose runs do not pass."""
    Path("sweep.toml").write_text(SWEEP.format(examples=EXAMPLES), encoding="utf-8")
    told = run("campaign run sweep.toml --out out --workers 1 --json", "campaign report out")
    return told + files("out/report.html") + page_text(Path("out/campaign.rrd"))


LOG: Final = """
7E5#0401000000000000 7E4#0400000000000000 7E5#4022010000000000 7E5#4111110000000000 7E5#4205000000000000
7E5#4301000000000000 7E4#4400000000000000 7E5#4622010000000000 7E5#4B09000000000000 7E4#4F00000000000000
7E5#4C00000000000000 7E4#5000000000000000 7E5#5100000000800000 7E5#5122010000050001 7E5#5122010000000101
7E5#5122010000030707 7E5#5A00000000000000 7E4#5A22010000000000 7E5#5D00000000000000 7E4#5D01000000000000
7E5#5E00000000000000 7E4#5E05000000000000 7E5#1105000000000000 7E5#11FF000000000000 7E4#1100000000000000
7E4#1101000000000000 7E4#11FF070000000000 7E4#1105000000000000 7E5#1300000000000000 7E5#1300080000000000
7E5#1300090000000000 7E5#1300050000000000 7E5#1301020000000000 7E4#1301000000000000 7E5#15E8030000000000
7E5#1700000000000000 7E4#1702000000000000 7E4#1701000000000000 7E5#9900000000000000 7E5#0402
7E4#1700000000000000 000#0101 000#8000 000#8105 000#8205 000#0205 000#7705 000#01 701#00 701#7F 701#05
701#04 701#85 701#R 701# 080# 080#07 100#00000000E803 100#0000 081#1082010000000000 081#0000000000000000
081#30810800007F0000 081#3081 601#4000100000000000 581#4392010200000000 601#4018100100000000
581#8018100100000206 601#4018100900000000 581#8018100911000906 601#2B40600006000000 581#6040600000000000
601#2F60600004000000 581#6060600000000000 601#4008100000000000 581#4108100009000000 601#6000000000000000
581#00736572766F6265 601#7000000000000000 581#1B6E630000000000 601#4041600000000000 581#4B41600037020000
601#406C600000000000 601#4064600000000000 581#8000000000000504 181#3706000010000000 281#E803000000000000
201#0F001400 1FFFFFFF#01 20000080#0000000000000000 20000004#0004000000000000 7FF#00 702#00
602#4000100000000000 582#8000100000000206
"""


def traced() -> str:
    """Frames of every service, and such as break its rules."""
    frames = enumerate(LOG.split())
    text = "".join(f"(1.{1000 * place:06d}) can0 {frame}\n" for place, frame in frames)
    Path("bus.log").write_text(text, encoding="utf-8")
    return run("trace bus.log", "trace bus.log --json")


def designed() -> str:
    """Gains, margins and certificates."""
    motor = "{examples}/motors/ling2012.toml"
    network = "--period-ms 10 --strategy arrival --loss-max 2 --tau-max-ms 4"
    return run(
        f"motor show {motor}",
        f"analyse speed {motor} --gain 0,-0.0212 --delay-ms 64",
        f"analyse speed {motor} --gain 0,-0.0212 {network}",
        f"design speed {motor} --error-percent 5 --load-nm 0.6 --speed-rpm 1500 --out speed.toml",
        f"design pid {motor} --latency-ms 1.5 --out pid.toml",
        "design current {examples}/motors/azaiz2007.toml --axis q --reduce 3 "
        "--sample-rate-hz 16000 --out kq.toml",
    ) + files("speed.toml", "pid.toml", "kq.toml")


ROW: Final = {
    "error_percent": 2.0,
    "published_delay_s": 0.082,
    "gamma": 0.9,
    "ccl_delay_s": 0.073,
    "lmi_delay_s": None,
    "exact_speed_feedback_delay_s": 0.0751,
    "exact_delay_s": 0.0832,
    "gain": [0.0012, -0.0212],
}
LOSSES: Final = {"sequences": 1, "age_max_s": 0.06}


def reproduced() -> str:
    """Figures and pictures of the papers; of Ling, three of the runs, and Table 2 and strategies made up."""
    table = {"published": [ROW, ROW | {"error_percent": 3.0, "lmi_delay_s": 0.08}], "si": [ROW]}
    strategies = {
        "stamp": LOSSES | {"by_losses": [{"decay_per_s": lost + 1.0, "gamma": 2.0} for lost in range(3)]},
        "history": LOSSES | {"by_losses": [{"decay_per_s": None, "gamma": 3.0}]},
    }
    motor = {
        "motor": "other",
        "load_nm": 1.25,
        "speed_rpm": 3000.0,
        "rows": [ROW, {"error_percent": 1.0, "gamma": 0.1, "impossible": "no gain keeps it"}],
    }
    with (
        patch.object(reproduction, "table2", lambda: table),
        patch.object(reproduction, "strategies", lambda: strategies),
        patch.object(reproduction, "for_motor", lambda _motor: motor),
        patch.object(reproduction, "VARIANTS", [reproduction.VARIANTS[place] for place in (0, 3, 5)]),
        drawn() as pictures,
    ):
        told = run(
            "reproduce ling2012 --figures one",
            "reproduce ling2012 --figures one --motor {examples}/motors/ling2012.toml",
            "reproduce azaiz2007 --figures two",
        )
    return told + "".join(pictures)


RUNS: Final = (
    "network_designed",
    "three_axes",
    "position_csp",
    "load_machine",
    "two_segments",
)


def ran() -> str:
    """Benches of every kind: what is printed, told as it happened, kept as figures; and a page."""
    told = ""
    for name in RUNS:
        told += run(f"run {{examples}}/{name}.toml --record {name}", f"review {name}")
        events = Path(name, "events.jsonl").read_text(encoding="utf-8").splitlines()
        told += "\n".join(sorted(events, key=lambda line: (json.loads(line)["at_ns"], line))) + "\n"
        told += files(f"{name}/summary.json")
    run("export two_segments --to jsonl")
    injected = Path("two_segments/faults.jsonl").read_text(encoding="utf-8").splitlines()
    return told + "\n".join(injected[::8]) + "\n" + page_text(Path("three_axes", "run.rrd"))


TELLING: Final = (
    commissioned,
    commissioned_by_speeds,
    measured,
    ran,
    reviewed,
    campaigned,
    traced,
    designed,
    reproduced,
)


@pytest.mark.long
@pytest.mark.parametrize("tell", TELLING)
def test_what_is_told(tell: Callable[[], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    hold(tell().replace(str(tmp_path), "FOLDER"), TOLD / f"{tell.__name__}.txt")
