"""Whatever has become of a file that a user names: its loader soon gives what it holds, or says bad input."""

import random
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from drivers.bounded_file import NamedBy
from drivers.dictionary import load_dictionary
from drivers.errors import BadInput
from drivers.printable import printable
from hil.commissioning.journal import read_journal
from hil.commissioning.request import load_nameplate
from hil.configuration.background import load_background
from hil.configuration.bench_file import load_bench, load_controller, load_faults
from hil.configuration.config_errors import BadInputs, bad_inputs_of
from hil.configuration.current_controller_file import read_current_controller
from hil.configuration.drive_file import load_drive_file
from hil.configuration.motor_file import load_motor
from hil.configuration.network_file import load_network
from hil.configuration.plant_file import load_plant
from hil.configuration.weights_file import load_weights
from tests.unit.drivers.sound_sheet import SOUND
from tests.unit.drivers.test_bounded_file import processor_s
from virtual_bus.canopen_device.parameter_store import FileStore
from virtual_bus.fault_injection.delay_histogram import read_histogram

EXAMPLES = Path(__file__).parents[3] / "examples"
PROCESSOR_S_MAX = 2.0
MUTANTS = 32
"""Of each kind of file: over 500 together, in a few seconds."""
MESSAGE_MAX = 2000
"""Characters of one error: what it repeats of the file is bounded, and so are the keys that it names."""


@dataclass(frozen=True)
class Kind:
    """A kind of file: one that is sound, and what loads it."""

    name: str
    text: str
    load: Callable[[Path], object]


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


def _example(name: str) -> str:
    return (EXAMPLES / name).read_text()


KINDS = [
    Kind("bench.toml", BENCH, load_bench),
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
    Kind("network.toml", NETWORK, load_network),
    Kind("drive.toml", DRIVE, load_drive_file),
    Kind("plate.toml", PLATE, load_nameplate),
    Kind("plant.json", PLANT, load_plant),
    Kind("faults.jsonl", RECORDED, load_faults),
    Kind("journal.jsonl", JOURNAL, read_journal),
    Kind("store.json", '{"6072:00": "e803"}', lambda path: FileStore(path).load()),
    Kind("delays.csv", _example("faults/gateway_delay.csv"), read_histogram),
    Kind("delays.json", '{"edges_us": [0, 10, 20], "counts": [3, 4]}', read_histogram),
    Kind("sound.eds", SOUND, load_dictionary),
]

NUMBERS = [
    *(b"1e308", b"-1e308", b"5e-324", b"1e400", b"nan", b"inf", b"-0", b"1_0", b"0x10", b"true"),
    *(b"18446744073709551616", b"9" * 400, b"9" * 5000, b"1e" + b"9" * 300, b"1." + b"9" * 100_000),
    *(b"\xc2\xb2", b"'1'", b"", b"2021-02-30"),
]
INSERTS = [
    *(b"[" * 3000, b"{" * 3000, b'{"a":' * 3000, b"a." * 50_000, b"k" * 100_000, b'"""', b"'''", b'"', b"#"),
    *(b"\x00", b"\xff\xfe", b"\x1b[2J", b'"\\u001b"', b"\xe2\x80\xae", b"="),
    *(b"\n[" + b" " * 20_000, b"\r" * 20_000),
]


def mutants(kind: Kind) -> Iterator[bytes]:
    """The same ones in every run: another number, something put in, the end torn off, octets overwritten."""
    draw = random.Random(kind.name)
    sound = kind.text.encode()
    numbers = [match.span() for match in re.finditer(rb"[0-9][0-9._]*", sound)]
    for _ in range(MUTANTS // 4):
        begin, end = draw.choice(numbers)
        yield sound[:begin] + draw.choice(NUMBERS) + sound[end:]
        place = draw.randrange(len(sound))
        yield sound[:place] + draw.choice(INSERTS) + sound[place:]
        yield sound[:place]
        yield sound[:place] + draw.randbytes(4) + sound[place + draw.randrange(9) :]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_mutated_file_is_loaded_or_refused(kind: Kind, tmp_path: Path) -> None:
    path = tmp_path / kind.name
    path.write_text(kind.text)
    kind.load(path)  # the sound one is
    for data in mutants(kind):
        path.write_bytes(data)
        begun = processor_s()
        try:
            kind.load(path)
        except (BadInput, BadInputs) as error:
            for item in bad_inputs_of(error):
                assert printable(str(item)) == str(item)
                assert len(str(item)) < MESSAGE_MAX
        assert processor_s() - begun < PROCESSOR_S_MAX, data[:200]
