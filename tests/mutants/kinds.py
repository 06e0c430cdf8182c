"""Every kind of file that a user names, with one that is sound."""

import re
from pathlib import Path
from typing import Final

from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.sheets.dictionary import load_dictionary
from servobench.hil.commissioning.request import load_nameplate
from servobench.hil.configuration.bench_file import load_bench, load_controller, load_faults
from servobench.hil.configuration.config import load_background
from servobench.hil.configuration.controller_files import read_current_controller
from servobench.hil.configuration.design_files import load_plant, load_weights
from servobench.hil.configuration.drive_file import load_drive_file
from servobench.hil.configuration.motor_file import load_motor
from servobench.hil.configuration.network_file import load_network
from servobench.hil.restoring.journal import read_journal
from servobench.virtual_bus.device.parameter_storage import FileStore
from servobench.virtual_bus.faults.kinds.measured_delay import read_histogram
from tests.mutants.mutant import Kind
from tests.unit.drivers.made_xdd import COMMISSIONED, xdd_text
from tests.unit.drivers.sound_sheet import SOUND

EXAMPLES: Final = Path(__file__).parents[2] / "examples"


def _named(path: Path) -> NamedBy:
    return NamedBy("bench.toml", "drive.axis1.motor", path.name)


PLANT = '{"A": [[-1.0]], "B": [[1.0, 1.0]], "C": [[1.0], [1.0]], "D": [[0.0, 1.0], [1.0, 0.0]], '
PLANT += '"controls": 1, "measurements": 1}'
RECORDED = (
    '{"at_ns": 5, "kind": "loss", "direction": "host_to_drive", "can_id": 385, "n": 3}\n'
    '{"at_ns": 9, "kind": "delay", "direction": "drive_to_host", "can_id": 385, "n": 4, "held_ns": 250000}\n'
)
JOURNAL = (
    '{"journal": 1, "bus": "hub:bench", "node": 1, "vendor": 1, "product": 2, "serial": 3, "nmt": 127}\n'
    '{"object": "6072:00", "old": "b80b", "new": "f401"}\n{"restored": 1}\n'
)
BENCH = re.sub('"(motors|faults)/', rf'"{EXAMPLES}/\1/', (EXAMPLES / "ling2012.toml").read_text())
NETWORK = "[network]\nperiod_us = 1000\nlosses_in_a_row_max = 2\ndelay_max_us = 1500\n"
DRIVE = '[drive]\nnode = 1\nvendor = 1\nproduct = 2\n[[object]]\nindex = 0x6072\nbytes = "e803"\n'
PLATE = "[rating]\ntorque_nm = 2.0\nspeed_rpm = 1500.0\n[limits]\ntorque_max_percent = 40.0\n"


def _example(name: str) -> bytes:
    return (EXAMPLES / name).read_bytes()


CONFIGURED = (
    SOUND.replace("DefaultValue=0x00020192\n", "DefaultValue=0x00020192\nParameterValue=0x00020192\n")
    + "[DeviceComissioning]\nNodeID=3\nBaudrate=1000\nNodeName=axis\n"
)
KINDS: Final = [
    Kind("bench.toml", BENCH.encode(), load_bench),
    Kind("motor.toml", _example("motors/ling2012.toml"), lambda path: load_motor(path, _named(path))),
    Kind("controller.toml", _example("controllers/network-k.toml"), load_controller),
    Kind(
        "current.toml",
        _example("controllers/azaiz2007-kq.toml"),
        lambda path: read_current_controller(path, _named(path)),
    ),
    Kind("weights.toml", _example("weights/azaiz2007-q.toml"), load_weights),
    Kind("background.toml", _example("background/plc.toml"), load_background),
    Kind("plan.toml", _example("faults/demo.toml"), load_faults),
    Kind("clocks.toml", _example("faults/clocks.toml"), load_faults),
    Kind("slow.toml", _example("faults/slow_drive.toml"), load_faults),
    Kind("network.toml", NETWORK.encode(), load_network),
    Kind("drive.toml", DRIVE.encode(), load_drive_file),
    Kind("plate.toml", PLATE.encode(), load_nameplate),
    Kind("plant.json", PLANT.encode(), load_plant),
    Kind("faults.jsonl", RECORDED.encode(), load_faults),
    Kind("journal.jsonl", JOURNAL.encode(), read_journal),
    Kind("store.json", b'{"6072:00": "e803"}', lambda path: FileStore(path).load()),
    Kind("delays.csv", _example("faults/gateway_delay.csv"), read_histogram),
    Kind("delays.json", b'{"edges_us": [0, 10, 20], "counts": [3, 4]}', read_histogram),
    Kind("sound.eds", SOUND.encode(), load_dictionary),
    Kind("configured.dcf", CONFIGURED.encode(), load_dictionary),
    Kind("drive.xdc", xdd_text(commissioning=COMMISSIONED).encode(), load_dictionary),
]
