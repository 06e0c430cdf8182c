"""One drive of a data sheet in simulated time: settings drawn, saved to a DCF, a factory reset, and loaded;
with ends of the loading host at drawn writes, after each of which the load goes on, or is undone.

What the drive holds is read from its dictionary, not by the product.
"""

import random
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, NamedTuple

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtCommand
from servobench.drivers.canopen.objects301 import BITS, REAL_BITS, SIGNED_BITS
from servobench.drivers.canopen.sdo import written_object
from servobench.drivers.canopen.write_list import NOTHING
from servobench.drivers.cia402.profile import State
from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.execution.device_files import DeviceFiles
from servobench.hil.execution.simulated_drives import servo_of
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.inspecting.loading import LoadRequest, concise_dcf, load_parameters
from servobench.hil.inspecting.parameters import configuration_text, parameters_of, read_parameters
from servobench.hil.restoring.journal import JournaledNetwork, read_journal
from servobench.hil.restoring.restore import restore
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.sdo_abort import SdoAbort, encode
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.witness.witness import Key, described

NODE: Final = 5
RATE: Final = 1_000_000
AT_THE_MOMENT: Final = frozenset(
    {0x1003, 0x1010, 0x1011, 0x1013, 0x6040, 0x6042, 0x6060, 0x6071, 0x607A, 0x60C1, 0x60FF}
)
"""Writable, and no parameters."""
PDOS: Final = range(0x1400, 0x1C00)
_TRIES: Final = 4
"""Values drawn for an object that the drive refuses, before it is left as it is."""
Held = dict[Key, bytes]


class Killed(BaseException):
    """The host's end by kill -9: nothing of it acts any more."""


class MortalHost(JournaledNetwork):
    """Ends at its write number ``dies_at``, before or after that is on the bus; 0: never."""

    dies_at = written = 0
    sends_it = False

    def send_request(self, node_id: int, request: bytes) -> Instant:
        if written_object(request) is not None:
            self.written += 1
            if self.written == self.dies_at:
                if self.sends_it:
                    super().send_request(node_id, request)
                    self.clock.sleep_until(Instant(self.clock.now() + NS_PER_S // 100))
                raise Killed
        return super().send_request(node_id, request)


class Outcome(NamedTuple):
    """What came of one sheet."""

    parameters: int
    drawn: int
    """Parameters that held another value than after the reset."""
    kills: int
    wrong: list[str]


class Bench:
    """A world with the drive alone, and hosts that come and go."""

    def __init__(self, world: World, drive: SimulatedServo, sheet: Path) -> None:
        self.world, self.drive, self.sheet = world, drive, sheet
        self.keys = [
            key
            for key, variable in sorted(described(sheet).items())
            if variable.readable and variable.writable and key[0] not in AT_THE_MOMENT
        ]

    def held(self) -> Held:
        """What the drive holds, as over SDO; an object that the drive refuses is left out."""
        found = {}
        for key in self.keys:
            variable = self.drive.dictionary.get(*key)
            if variable is not None and variable.readable:
                found[key] = self.drive.dictionary.upload(*key)
        return found

    def host(self) -> MortalHost:
        return MortalHost(self.world.link, self.world.clock, NOTHING)

    def reset(self) -> None:
        """Factory settings, and the node's reset."""
        self.drive.dictionary.download(0x1011, 1, b"load")
        self.restart()

    def restart(self) -> None:
        """The node's reset."""
        network = CanopenNetwork(self.world.link, self.world.clock)
        network.command(NmtCommand.RESET_NODE, NODE)
        network.pump(Instant(network.clock.now() + NS_PER_S // 2))

    def save(self, path: Path, sheet: Path | None) -> dict[Key, str]:
        """``hil params save``; what could not be saved. ``sheet``: None for a scan."""
        network = self.host()
        read, dictionary, identity = read_parameters(network, NODE, sheet, "simulated", lambda _: None)
        text = configuration_text(read, dictionary, identity, RATE)
        path.write_bytes(concise_dcf(read) if path.suffix == ".bin" else text.encode())
        return dict(read.unread)

    def manage(self, path: Path) -> dict[Key, str]:
        """Write a concise DCF entry by entry, as a manager does after a node's boot-up; what is refused."""
        data, refused = path.read_bytes(), dict[Key, str]()
        (count,), place = struct.unpack_from("<I", data), 4
        for _ in range(count):
            index, sub, size = struct.unpack_from("<HBI", data, place)
            place += 7 + size
            try:
                self.drive.dictionary.download(index, sub, data[place - size : place])
            except SdoAbort as error:
                refused[index, sub] = f"{error.code:08X}h"
        assert place == len(data)
        return refused

    def load(
        self, path: Path, out: Path, dies_at: int = 0, sends_it: bool = False, sheet: Path | None = None
    ) -> tuple[int, dict[Key, str]]:
        """``hil params load``; the number of writes, and what was refused. Raises Killed."""
        network = self.host()
        network.dies_at, network.sends_it = dies_at, sends_it
        request = LoadRequest("simulated", RATE, NODE, out)
        wanted = parameters_of(path, NODE, sheet)
        loaded = load_parameters(network, wanted, request, lambda _: None)
        return network.written, dict(loaded.refused)

    def undo(self, out: Path) -> list[str]:
        """``hil restore``; what is still otherwise."""
        network = self.host()
        journal = read_journal(out / "journal.jsonl")
        read_parameters(network, NODE, self.sheet, "simulated", lambda _: None)  # who it is
        network.putting_back = True
        return restore(network, journal).failures


@contextmanager
def on_a_bench(sheet: Path) -> Iterator[Bench]:
    """A drive made from the sheet."""
    parameters = DriveParameters()
    servo = servo_of(
        DeviceFiles(eds=sheet), NODE, LING, parameters, announce=lambda _: None, bitrate_bit_s=RATE
    )
    with open_world(WorldPlan(parse_bus_spec("simulated"), RATE, False, None, 0), [servo]) as world:
        CanopenNetwork(world.link, world.clock).pump(Instant(world.clock.now() + Duration(NS_PER_S // 2)))
        yield Bench(world, servo, sheet)


def draw_settings(bench: Bench, draw: random.Random) -> None:
    """Another value for each parameter, as far as the drive takes one."""
    dictionary = bench.drive.dictionary
    for pdo in sorted({index for index, _ in bench.keys if index in PDOS and not index & 0x200}):
        _draw_pdo(bench, pdo, draw)
    order = [key for key in bench.keys if key[0] not in PDOS]
    draw.shuffle(order)
    for key in order:
        variable = dictionary.get(*key)
        if variable is None or variable.refusal(variable.read()) is not None:
            continue  # it is not there, or the drive could not be given back what it holds
        for _ in range(_TRIES):
            if _is_taken(bench, key, _drawn(variable, draw)):
                break


def _is_taken(bench: Bench, key: Key, value: bytes) -> bool:
    try:
        bench.drive.dictionary.download(*key, value)
    except SdoAbort:
        return False
    return True


def _drawn(variable: Variable, draw: random.Random) -> bytes:
    bits = BITS.get(variable.data_type)
    if bits is None:
        return "".join(draw.choices("abcXYZ 0123", k=draw.randrange(1, 9))).strip().encode()
    if variable.data_type in REAL_BITS:
        return encode(variable.data_type, round(draw.uniform(-1e3, 1e3), 3))
    signed = variable.data_type in SIGNED_BITS
    low = (-(1 << (bits - 1)) if signed else 0) if variable.low is None else variable.low
    high = ((1 << (bits - signed)) - 1) if variable.high is None else variable.high
    few = draw.random() < 0.5
    return encode(variable.data_type, draw.randint(int(low), int(min(high, low + 200) if few else high)))


def _draw_pdo(bench: Bench, index: int, draw: random.Random) -> None:
    """A PDO's parameters by the standard's procedure."""
    transmit = index >= 0x1800
    mapping = index + 0x200
    dictionary = bench.drive.dictionary
    cob_id = dictionary.get(index, 1)
    if cob_id is None or not _is_taken(bench, (index, 1), encode(cob_id.data_type, cob_id.value | 1 << 31)):
        return
    able = [
        variable
        for entry in dictionary
        for variable in entry.members.values()
        if (variable.mappable_in_tpdo if transmit else variable.mappable_in_rpdo) and entry.index >= 0x6000
    ]
    words = [
        each.index << 16 | each.subindex << 8 | (each.bits or 0)
        for each in draw.sample(able, min(len(able), draw.randrange(3)))
    ]
    if words and _is_taken(bench, (mapping, 0), b"\0"):
        for sub, word in enumerate(words, start=1):
            _is_taken(bench, (mapping, sub), word.to_bytes(4, "little"))
        _is_taken(bench, (mapping, 0), bytes([len(words)]))
    for sub in (2, 3, 5, 6):
        if (variable := dictionary.get(index, sub)) is not None and variable.writable:
            _is_taken(bench, (index, sub), _drawn(variable, draw))
    number = draw.randrange(0x680, 0x6E0) if draw.random() < 0.5 else cob_id.value & 0x7FF
    off = 1 << 31 if draw.random() < 0.3 else 0
    _is_taken(bench, (index, 1), encode(cob_id.data_type, number | off))


def differing(expected: Held, found: Held) -> list[str]:
    """Objects that hold another value, with both."""
    keys = sorted(expected.keys() | found.keys())
    show: Callable[[bytes | None], str] = lambda value: "none" if value is None else value.hex()  # noqa: E731
    return [
        f"{key[0]:04X}h:{key[1]:02X} {show(found.get(key))}, not {show(expected.get(key))}"
        for key in keys
        if expected.get(key) != found.get(key)
    ]


def tried(sheet: Path, folder: Path, seed: str, kills: int, scans: bool = False) -> Outcome:
    """All of it, for one sheet; ``scans``: without the sheet too, which takes as long as all the rest."""
    draw, wrong = random.Random(f"{seed}"), list[str]()
    with on_a_bench(sheet) as bench:
        draw_settings(bench, draw)
        file, set_up = folder / "drive.dcf", bench.held()
        concise, scanned = folder / "drive.bin", folder / "scanned.dcf"
        unsaved = {**bench.save(file, sheet), **bench.save(concise, sheet)}
        unscanned = bench.save(scanned, None) if scans else {}
        bench.reset()
        factory = bench.held()
        excused = {f"{index:04X}h:{sub:02X}" for index, sub in unsaved}

        def judge(title: str, expected: Held, refused: dict[Key, str]) -> None:
            named = excused | {f"{index:04X}h:{sub:02X}" for index, sub in refused}
            wrong.extend(
                f"{title}: {text}" for text in differing(expected, bench.held()) if text[:8] not in named
            )
            wrong.extend(
                f"{title}: {index:04X}h:{sub:02X} refused: {why}" for (index, sub), why in refused.items()
            )
            if bench.drive.drive.power.state is State.OPERATION_ENABLED:
                wrong.append(f"{title}: left enabled")

        writes, refused = bench.load(file, folder / "whole")
        judge("loaded", set_up, refused)
        wrong.extend(f"undone: {text}" for text in bench.undo(folder / "whole"))
        judge("undone", factory, {})
        refused, held = bench.manage(concise), bench.held()  # of a default beyond its limits it holds that
        judge("by a manager", set_up, {key: why for key, why in refused.items() if held[key] != set_up[key]})
        bench.reset()
        judge("concise", set_up, bench.load(concise, folder / "concise", sheet=sheet)[1])
        wrong.extend(f"concise, undone: {text}" for text in bench.undo(folder / "concise"))
        if scans:
            of_others = bench.load(scanned, folder / "scanned")[1]
            programs = {key for key in bench.keys if key[0] in range(0x1F50, 0x1F5A)}  # are left alone
            excused |= {f"{index:04X}h:{sub:02X}" for index, sub in {*unscanned, *programs}}
            judge("scanned", set_up, {key: why for key, why in of_others.items() if key in bench.keys})
            wrong.extend(f"scanned, undone: {text}" for text in bench.undo(folder / "scanned"))
        judge("undone again", factory, {})
        for number in range(kills if writes else 0):
            at = 1 + (number * writes + draw.randrange(writes)) // kills
            out, sends_it = folder / f"kill{number}", bool(draw.randrange(2))
            title = f"killed {'behind' if sends_it else 'before'} write {at}"
            for way in ("undone", "gone on with"):
                bench.reset()
                judge("reset", factory, {})
                with suppress(Killed):
                    bench.load(file, out / way, at, sends_it)
                    wrong.append(f"{title}: it ended by itself")
                if way == "gone on with":
                    judge(f"{title}, {way}", set_up, bench.load(file, out / way)[1])
                wrong.extend(f"{title}, {way}, undone: {text}" for text in bench.undo(out / way))
                judge(f"{title}, {way}, undone", factory, {})
    return Outcome(len(set_up), len(differing(factory, set_up)), kills, wrong)
