"""The kind of fault that docs/simulated-drive.md writes: one file and its name in the register are enough."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs" / "simulated-drive.md"
REGISTER = ROOT / "virtual_bus" / "faults" / "register.py"

TRY_IT = """
import json, sys, types

def module(name, text):
    made = types.ModuleType(name)
    sys.modules[name] = made
    exec(compile(text, name, "exec"), made.__dict__)

kind, register = json.load(sys.stdin)
module("virtual_bus.faults.kinds.wake_up_loss", kind)
module("virtual_bus.faults.register", register)

from drivers.timebase import Instant
from virtual_bus.bus.judge import LOST
from virtual_bus.faults.fault_injector import FaultInjector
from virtual_bus.faults.fault_log import FaultLog, entry_line, read_line
from virtual_bus.faults.fault_plan import load_fault_plan, read_fault_plan
from virtual_bus.faults.replay import RecordedFaults, ReplayedFates

AT = (0, 400, 900, 2_000, 2_100, 9_000)

def lost(fates):
    fates.start(Instant(0))
    return [at for at in AT if fates.hold(1, 0x181, Instant(at * 1000), False) == LOST]

log, again = FaultLog(), FaultLog()
plan = load_fault_plan({"wake_up_loss": [{"idle_s": 0.001, "until_s": 0.005}]}, "plan.toml")
injector = FaultInjector(plan, 1, log=log)
struck = lost(injector)
lines = [entry_line(entry) for entry in log.entries()]
recorded = RecordedFaults(tuple(read_line(line, "f", 1) for line in lines))
errors = read_fault_plan({"wake_up_loss": [{"idle_ms": 1}, {"idle_s": 0}]}, "plan.toml")[1]
json.dump(
    {
        "struck": struck,
        "replayed": lost(ReplayedFates(recorded, again)),
        "written": load_fault_plan(plan.as_tables(), "written") == plan,
        "counts": injector.counts()["drive_to_host"],
        "line": lines[0],
        "errors": [str(error) for error in errors],
    },
    sys.stdout,
)
"""


def test_the_kind_of_the_docs_works_from_its_table_to_its_replay() -> None:
    text = DOCS.read_text(encoding="utf-8")
    kind = text[text.index("## Write your own fault") :].partition("```python\n")[2].partition("```")[0]
    register = REGISTER.read_text(encoding="utf-8")
    name = "from virtual_bus.faults.kinds.wake_up_loss import WakeUpLoss\n"
    first = "from virtual_bus.faults.log_kind"
    changed = register.replace(first, name + first).replace(
        "    HostStall,\n", "    HostStall,\n    WakeUpLoss,\n"
    )
    assert len(changed.splitlines()) == len(register.splitlines()) + 2
    done = subprocess.run(
        [sys.executable, "-c", TRY_IT],
        input=json.dumps([kind, changed]),
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    seen = json.loads(done.stdout)
    assert seen["struck"] == seen["replayed"] == [0, 2_000], "at 9 ms its window is over"
    assert seen["written"]
    assert seen["counts"] == {"frames": 6, "wake_up_loss": 2, "delayed": 0}
    assert seen["line"] == '{"kind":"wake_up_loss","at_ns":0,"direction":"drive_to_host","can_id":385,"n":0}'
    unknown, zero = seen["errors"]
    assert "wake_up_loss[0].idle_ms: found 1, expected idle_s (the unit is part of the key)" in unknown
    assert "wake_up_loss[1].idle_s: found 0, expected a time > 0" in zero
