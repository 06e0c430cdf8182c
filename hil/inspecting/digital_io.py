"""A drive's digital inputs and outputs, 60FDh and 60FEh: read, set with journal and undo, switches tried.

60FDh     bit 0 negative limit switch, 1 positive limit switch, 2 home switch, 3 interlock, 16 on: the maker's
60FEh:1   bit 0 set brake, 16 on: the maker's; :2 is the mask of those that a master decides
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, duration_s
from servobench.hil.inspecting.loading import JOURNAL, check_disabled, check_rest
from servobench.hil.inspecting.parameters import CONNECT_NS
from servobench.hil.restoring.journal import Journal, JournaledNetwork, ObjectKey, ObjectWrite
from servobench.hil.restoring.restore import head_of

INPUTS: Final = {0: "negative limit switch", 1: "positive limit switch", 2: "home switch", 3: "interlock"}
OUTPUTS: Final = {0: "set brake"}
BITS: Final = range(1, 32)
"""Outputs that may be set: ``hil brake`` alone turns the brake's."""
SWITCHES: Final = {"negative": 0, "positive": 1, "home": 2}
PHYSICAL: Final = 1
MASK: Final = 2
"""Sub-indices of 60FEh."""
_KEYS: Final = {sub: ObjectKey(Object.DIGITAL_OUTPUTS, sub) for sub in (PHYSICAL, MASK)}
_LOADS: Final = "digital outputs"
"""Mark of a journal of outputs, with which a further one goes on."""
_POLL: Final = Duration(2 * NS_PER_MS)
"""Two frames of at most 135 bits are 13 % of 1 Mbit/s; a contact by hand closes for a tenth of a second."""
_QUIET_S: Final = 0.3
"""A switch that has its level of before for so long was let go: contacts bounce for some milliseconds."""


class Panel(NamedTuple):
    """What a drive tells; None: it lacks the object."""

    inputs: int | None
    outputs: int | None
    mask: int | None

    def lines(self) -> list[str]:
        """In words, a line for each named bit and each of the maker's that is 1."""
        texts = []
        if self.inputs is None:
            texts.append("no digital inputs (60FDh)")
        for bit, name in _named(self.inputs, INPUTS):
            texts.append(f"input {bit:2} {name:<22} {_bit(self.inputs, bit)}")
        if self.outputs is None:
            return [*texts, "no digital outputs (60FEh)"]
        for bit, name in _named(self.outputs | (self.mask or 0), OUTPUTS):
            by = "the master" if _bit(self.mask, bit) else "the drive"
            texts.append(f"output {bit:2} {name:<21} {_bit(self.outputs, bit)} by {by}")
        return texts


def _bit(word: int | None, bit: int) -> int:
    return (word or 0) >> bit & 1


def _named(word: int | None, names: Mapping[int, str]) -> list[tuple[int, str]]:
    """Return the bits of ``names`` and those that are 1."""
    if word is None:
        return []
    return [(bit, names.get(bit, "")) for bit in range(32) if bit in names or word >> bit & 1]


def read_panel(objects: RemoteObjects) -> Panel:
    """Read 60FDh and 60FEh."""
    return Panel(
        objects.read_if_there(Object.DIGITAL_INPUTS),
        *(objects.read_if_there(Object.DIGITAL_OUTPUTS, sub) for sub in _KEYS),
    )


@dataclass(frozen=True, slots=True)
class OutputRequest:
    """Outputs to set."""

    bus: str
    bitrate_bit_s: int
    node: int
    out: Path
    """Folder of the journal."""
    levels: Mapping[int, bool]
    """By bit."""

    @property
    def journal(self) -> Path:
        """The file of the journal."""
        return self.out / JOURNAL


def set_outputs(network: JournaledNetwork, request: OutputRequest) -> Panel:
    """Set outputs of a drive that is disabled and stands; return what it tells then.

    The journal goes on with that of outputs set before. Levels come before the mask, so that none is decided
    by the master with its former level. Raises PeerFault for a drive that is enabled, moves or lacks 60FEh,
    SettingRefused for one that holds something else, BadInput if the journal of something else waits.
    """
    drive = ServoDrive(network, request.node)
    identity = drive.connect(network.deadline_after(CONNECT_NS))
    objects = drive.objects
    check_rest(objects)
    held = read_panel(objects)
    if held.outputs is None or held.mask is None:
        raise PeerFault(f"node {request.node} has no outputs to set", "60FEh:1 or 60FEh:2 is missing")
    drives = {MASK: held.mask, PHYSICAL: held.outputs}
    wanted = dict(drives)
    for bit, level in request.levels.items():
        wanted[MASK] |= 1 << bit
        wanted[PHYSICAL] = wanted[PHYSICAL] & ~(1 << bit) | level << bit
    head = head_of(objects, request.bus, request.bitrate_bit_s, identity)
    journal = Journal(request.journal, replace(head, loads=_LOADS))
    network.journals[request.node] = journal
    try:
        known = journal.contents.originals()
        changes = (ObjectWrite(_KEYS[sub], _octets(drives[sub]), _octets(wanted[sub])) for sub in drives)
        journal.note(*(each for each in changes if each.object not in known))
        for sub in (PHYSICAL, MASK):
            objects.write(Object.DIGITAL_OUTPUTS, sub, "I", wanted[sub])
    finally:
        journal.close()
    told = read_panel(objects)
    if any(
        (_bit(told.outputs, bit), _bit(told.mask, bit)) != (level, 1) for bit, level in request.levels.items()
    ):
        raise SettingRefused(
            f"node {request.node} does not set its outputs so",
            f"60FEh:1 is {told.outputs:08X}h, 60FEh:2 {told.mask:08X}h",
        )
    return told


def _octets(word: int) -> bytes:
    return word.to_bytes(4, "little")


class SwitchTried(NamedTuple):
    """What became of one switch that somebody was to actuate."""

    name: str
    right: bool
    text: str


def try_switches(
    objects: RemoteObjects,
    names: Sequence[str],
    limit_s: float,
    tell: Callable[[str], None],
    check_stop: Callable[[], None] = lambda: None,
) -> list[SwitchTried]:
    """Have somebody actuate one switch after the other, and see which input follows, and which way.

    ``limit_s``: time for each. Nothing is written. Raises PeerFault for a drive that is enabled, or that
    lacks 60FDh.
    """
    check_disabled(objects)
    tried = []
    for name in names:
        tell(f"actuate the switch '{name}' for a moment")
        before, edges = _edges(objects, limit_s, check_stop)
        tried.append(SwitchTried(name, *_judged(name, before, edges)))
        tell(f"  {name}: {tried[-1].text}")
    return tried


def _edges(
    objects: RemoteObjects, limit_s: float, check_stop: Callable[[], None]
) -> tuple[int, dict[int, int]]:
    """Return the inputs at rest, and how often the bit of each switch changed until they were so again."""
    network = objects.network
    deadline = network.deadline_after(duration_s(limit_s))
    last = rest = objects.read(Object.DIGITAL_INPUTS)
    edges = dict.fromkeys(SWITCHES.values(), 0)
    changed_at = network.clock.now()
    while network.clock.now() < deadline:
        check_stop()
        network.pump(network.deadline_after(_POLL))
        bits = objects.read(Object.DIGITAL_INPUTS)
        for bit in edges:
            edges[bit] += (bits ^ last) >> bit & 1
        if bits != last:
            last, changed_at = bits, network.clock.now()
        if any(edges.values()) and bits == rest and network.clock.now() - changed_at > _QUIET_S * NS_PER_S:
            break
    return rest, edges


def _judged(name: str, rest: int, edges: Mapping[int, int]) -> tuple[bool, str]:
    own = SWITCHES[name]
    if not edges[own]:
        others = [other for other, bit in SWITCHES.items() if edges[bit]]
        return (
            False,
            f"SWAPPED: it is wired to {' and '.join(others)}" if others else "NOT SEEN: no input changed",
        )
    if rest >> own & 1:
        return False, "INVERTED: its bit was 1 at rest and 0 while it was actuated"
    if edges[own] % 2:
        return False, "STAYS: its bit did not come back to 0"
    if edges[own] > 2:
        return False, f"BOUNCES: {edges[own]} changes for one actuation"
    return True, "right: 0 at rest, 1 while it was actuated"
