"""Objects of a drive over time: out of the PDOs that it sends anyway, else asked for by SDO, one by one.

An object whose PDO does not come (no SYNC, node not operational) is asked for by SDO from then on.

Nothing is written. A sample of a PDO has the instant at which its frame came; the drive took it some time
before, with the SYNC or by its own timer. One of an SDO lies between request and answer: its instant is the
middle, ``within`` half of the time between.
"""

import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import Cia301, object_name
from servobench.drivers.canopen.pdo import PdoDirection
from servobench.drivers.cia402.scaling import FACTOR_OBJECTS
from servobench.drivers.errors import BadInput, PeerFault, TransferAborted
from servobench.drivers.sheets.dictionary import LoadedDictionary
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, duration_s
from servobench.hil.reviewing.trace.node_objects import NodeObjects
from servobench.hil.reviewing.trace.pdo_book import PdoBook, PdoLayout

Key = tuple[int, int]
"""Index and sub-index."""
BY_SDO: Final = "SDO"
_OBJECT: Final = re.compile(r"([0-9a-fA-F]{4})h?(?::([0-9a-fA-F]{1,2}))?")
_TPDOS_MAX: Final = 8
"""More are looked for only where each of these is there."""
_ROUND: Final = Duration(2 * NS_PER_MS)
"""From one round of requests to the next, at the least: two frames of 135 bits are 13 % of 1 Mbit/s."""
_PDO_WAIT_S: Final = 0.5
"""So long a PDO may stay away, or half of the watch: SYNC periods and event timers are shorter as a rule."""
_LOOK: Final = Duration(50 * NS_PER_MS)
"""So long a request to stop may wait where no object is asked for."""


def key_in(text: str) -> Key:
    """Parse ``6077`` or ``2101:01``, both hexadecimal. Raises BadInput."""
    match = _OBJECT.fullmatch(text.strip())
    if match is None:
        raise BadInput("--object", "", text, "an index in hexadecimal, and a sub-index: 6077, 2101:01")
    return int(match[1], 16), int(match[2] or "0", 16)


@dataclass(slots=True)
class Channel:
    """One object with its samples."""

    key: Key
    source: str
    """``TPDO1``, or :data:`BY_SDO`."""
    name: str
    silent: str = ""
    """The TPDO that carries it and did not come; empty: none does."""
    unit: str = ""
    """Empty: raw numbers."""
    lack: str = ""
    """Why no sample is there; empty: some are."""
    at: list[Instant] = field(default_factory=list)
    within: list[Duration] = field(default_factory=list)
    """Uncertainty of each instant; 0 of a PDO's."""
    values: list[float] = field(default_factory=list)

    @property
    def title(self) -> str:
        """Object and name."""
        return f"{object_name(*self.key)} {self.name}".strip()

    @property
    def rate_hz(self) -> float:
        """Samples a second, between the first and the last; NaN with fewer than two."""
        return (len(self.at) - 1) / ((self.at[-1] - self.at[0]) / NS_PER_S) if len(self.at) > 1 else math.nan

    @property
    def gap_s(self) -> float:
        """Longest time between two samples; NaN with fewer than two."""
        return float(np.diff(np.array(self.at)).max()) / NS_PER_S if len(self.at) > 1 else math.nan

    @property
    def within_s(self) -> float:
        """Largest uncertainty of an instant."""
        return max(self.within, default=0) / NS_PER_S

    def as_json(self) -> dict[str, Any]:
        """Figures for ``--json``."""
        told = {"object": object_name(*self.key), "name": self.name, "unit": self.unit, "source": self.source}
        if self.silent:
            told["silent"] = self.silent
        if self.lack:
            return {**told, "samples": 0, "lack": self.lack}
        return {
            **told, "samples": len(self.values), "rate_hz": self.rate_hz, "gap_s": self.gap_s,
            "within_s": self.within_s, "min": min(self.values), "mean": float(np.mean(self.values)),
            "max": max(self.values),
        }  # fmt: skip

    def take(self, at: Instant, within: Duration, value: float) -> None:
        """Add a sample."""
        self.at.append(at)
        self.within.append(within)
        self.values.append(value)


class Scope:
    """Looks at objects of one node."""

    def __init__(
        self,
        network: CanopenNetwork,
        node: int,
        keys: Sequence[Key],
        sheet: LoadedDictionary | None,
        by_sdo: bool,
    ) -> None:
        """``by_sdo``: ask for what comes in PDOs too. Raises NoAnswer."""
        self._network, self._node = network, node
        self._objects = objects = NodeObjects()
        if sheet is not None:
            objects.use_sheet(sheet.dictionary)
        self._ask((Cia301.IDENTITY, 1), (Cia301.IDENTITY, 2), (Cia301.DEVICE_NAME, 0), *FACTOR_OBJECTS)
        layouts = {} if by_sdo else self._layouts()
        self._frames: dict[int, PdoLayout] = {}
        self.channels = [self._channel(key, layouts) for key in dict.fromkeys(keys)]
        self.ended_by: PeerFault | None = None
        """A fault of node or bus that ended the watch early; the samples before it are kept."""

    def watch(self, seconds: float, stopped: Callable[[], bool]) -> list[Channel]:
        """Take samples for ``seconds``, or until ``stopped``, or the node falls silent: :attr:`ended_by`."""
        network = self._network
        for can_id, layout in self._frames.items():
            network.listen(can_id, partial(self._take_frame, layout))
        try:
            end = network.deadline_after(duration_s(seconds))
            due = network.deadline_after(duration_s(min(_PDO_WAIT_S, 0.5 * seconds)))
            while network.clock.now() < end and not stopped():
                begun = network.clock.now()
                if begun >= due:
                    self._ask_for_what_stays_away()
                asked = [each for each in self.channels if each.source == BY_SDO and not each.lack]
                for each in asked:
                    self._take_answer(each)
                network.pump(min(end, Instant(begun + (_ROUND if asked else _LOOK))))
        except PeerFault as error:
            self.ended_by = error
        finally:
            for can_id in self._frames:
                network.unlisten(can_id)
        for each in self.channels:
            if not each.values and not each.lack:
                each.lack = "no sample before the end"
        return self.channels

    def _ask_for_what_stays_away(self) -> None:
        """Turn to SDO for each object whose PDO has not come."""
        for each in self.channels:
            if each.source != BY_SDO and not each.values and not each.lack:
                each.silent, each.source = each.source, BY_SDO

    def _ask(self, *keys: Key) -> None:
        """Have the node tell objects that names and units rest on."""
        for key in keys:
            try:
                self._objects.take(*key, self._network.upload(self._node, *key))
            except TransferAborted:
                self._objects.lacks(*key)

    def _layouts(self) -> dict[int, PdoLayout]:
        """Return the TPDOs that the node sends, by identifier."""
        numbers = []
        for number in range(1, 513):
            parameter = PdoDirection.TRANSMIT.value + number - 1, 1
            if number > _TPDOS_MAX and number - 1 not in numbers:
                break
            try:
                word = self._network.upload(self._node, *parameter)
            except TransferAborted:
                continue
            self._objects.take(*parameter, word)
            numbers.append(number)
            mapping = PdoDirection.TRANSMIT.mapping_base + number - 1
            with suppress(TransferAborted):
                count = self._network.upload(self._node, mapping, 0)
                self._objects.take(mapping, 0, count)
                self._ask(*((mapping, sub) for sub in range(1, count[0] + 1)))
        book, nodes = PdoBook(), {self._node: self._objects}
        layouts = {}
        for number in numbers:
            told = self._objects.held(PdoDirection.TRANSMIT.value + number - 1, 1) or 0
            layout = book.layout(told & 0x7FF, nodes)
            if layout is not None and layout.objects and layout.name == f"TPDO{number}":
                layouts[told & 0x7FF] = layout
        return layouts

    def _channel(self, key: Key, layouts: dict[int, PdoLayout]) -> Channel:
        name = self._objects.number(*key, None).name
        for can_id, layout in layouts.items():
            if key in [(each.index, each.sub) for each in layout.objects or ()]:
                self._frames[can_id] = layout
                return Channel(key, layout.name, name)
        return Channel(key, BY_SDO, name)

    def _take_frame(self, layout: PdoLayout, data: bytes, at: Instant) -> None:
        values = {(each.index, each.sub): each for each in layout.values(data, self._objects)}
        for channel in self.channels:
            value = values.get(channel.key)
            if value is not None and channel.source == layout.name:
                self._take(channel, at, Duration(0), value)

    def _take_answer(self, channel: Channel) -> None:
        """Ask once; an object that is refused is asked for no more."""
        begun = self._network.clock.now()
        try:
            data = self._network.upload(self._node, *channel.key)
        except TransferAborted as error:
            channel.lack = str(error)
            return
        ended = self._network.clock.now()
        half = Duration((ended - begun + 1) // 2)
        self._take(channel, Instant(begun + half), half, self._objects.value(*channel.key, data))

    def _take(self, channel: Channel, at: Instant, within: Duration, value: Any) -> None:
        number = value.raw if value.si is None else value.si
        if not isinstance(number, int | float):
            channel.lack = f"{value.shown} is no number"
            return
        channel.unit = value.unit if value.si is not None else ""
        channel.take(at, within, float(number))


def lines_of(channels: Sequence[Channel]) -> list[str]:
    """Return what was seen, a line for each object."""
    texts = []
    for each in channels:
        if each.lack:
            texts.append(f"{each.title} by {each.source}: {each.lack}")
            continue
        unit = f" {each.unit}" if each.unit else ""
        within = f", within {1e3 * each.within_s:.3g} ms" if each.within_s else ""
        silent = f" (no {each.silent} came: not operational, or no SYNC)" if each.silent else ""
        low, mean, high = min(each.values), float(np.mean(each.values)), max(each.values)
        way = f"{len(each.values)} by {each.source}{silent}"
        texts.append(
            f"{each.title}: {low:.6g} .. {mean:.6g} .. {high:.6g}{unit}; {way}, "
            f"{each.rate_hz:.4g} a second, {1e3 * each.gap_s:.3g} ms apart at most{within}"
        )
    return texts


def seen_all(channels: Sequence[Channel]) -> bool:
    """Return True if each object has samples."""
    return all(each.values and not each.lack for each in channels)
