"""Touch probe, 60B8h to 60BDh (CiA 402-2, touch probe functionality): positions captured at edges.

    60B8h bits 0 to 5, of probe 2 bits 8 to 13     60B9h bits 0 to 2, of probe 2 bits 8 to 10
      0  enabled                                     0  enabled
      1  each event, else the first alone            1  positive edge stored (60BAh, 60BCh)
      2, 3  0 its input, 1 the zero impulse,         2  negative edge stored (60BBh, 60BDh)
            2 what 60D0h says
      4  positive edges, 5 negative edges

60D0h:1 and :2 are 1 or 2 for the input of probe 1 or 2, 5 or 6 for the zero impulse, which is the same by
hardware (5) and by software (6) here; the numbers are those that makers print (Beckhoff AX8xxx, 60D0:01).

The inputs are bits 0 and 1 of 2110h:11; an edge captures at the inner tick in which it is written. The zero
impulse, whose edges both lie at its count, is looked for between one look at these objects and the next.
"""

from collections.abc import Callable
from typing import Final

from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.objects402 import Object
from servobench.virtual_bus.core.native import InnerLoops
from servobench.virtual_bus.device.object_dictionary import Access, DictionaryObject, ObjectDictionary
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.drive.servo_objects import one_of
from servobench.virtual_bus.drive.user_units import UserUnits

INPUTS_SUB: Final = 11
_ENABLED: Final = 1 << 0
_CONTINUOUS: Final = 1 << 1
_ZERO_IMPULSE, _BY_SOURCE, _SOURCES = 0b01, 0b10, 0b11
_INPUT_SOURCES: Final = (1, 2)
_ZERO_SOURCES: Final = (5, 6)
_IMPULSE: Final = 2
"""In the place of a probe's number: the zero impulse."""
_POSITIVE, _NEGATIVE = 1 << 4, 1 << 5
_STORED_SHIFT: Final = 3
"""From an edge's bit of the function to that of the status."""
_PROBES: Final = (0, 1)
_VALUES: Final = (
    (Object.TOUCH_PROBE_1_POSITIVE_EDGE, 0, _POSITIVE),
    (Object.TOUCH_PROBE_1_NEGATIVE_EDGE, 0, _NEGATIVE),
    (Object.TOUCH_PROBE_2_POSITIVE_EDGE, 1, _POSITIVE),
    (Object.TOUCH_PROBE_2_NEGATIVE_EDGE, 1, _NEGATIVE),
)


class TouchProbes:
    """Both probes."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        machine: DictionaryObject,
        inner: InnerLoops,
        units: UserUnits,
        next_index: Callable[[float, int], float],
    ) -> None:
        """``machine``: the record 2110h; ``next_index``: the zero impulse beyond a count."""
        self._inner, self._units, self._next_index = inner, units, next_index
        self._word = self._inputs = 0
        sources = dictionary.add_array(Object.TOUCH_PROBE_SOURCE, Object.TOUCH_PROBE_SOURCE.title)
        self._sources = [1, 2]
        self._chosen = [
            sources.add(
                probe + 1, f"Touch probe {probe + 1} source", DataType.INTEGER16,
                default=probe + 1, check=one_of((*_INPUT_SOURCES, *_ZERO_SOURCES)),
                on_write=lambda _source: self._look(),
            )
            for probe in _PROBES
        ]  # fmt: skip
        self._stored = [0, 0]
        self._count = 0.0
        self._places = {(probe, edge): 0 for _, probe, edge in _VALUES}
        u16, i32, u8 = DataType.UNSIGNED16, DataType.INTEGER32, DataType.UNSIGNED8
        function, status = Object.TOUCH_PROBE_FUNCTION, Object.TOUCH_PROBE_STATUS
        self._function = dictionary.add(
            function, function.title, u16, mappable=True, stored=False, check=_refused,
            on_write=lambda _word: self._look(),
        )  # fmt: skip
        dictionary.add(status, status.title, u16, Access.READ_ONLY, mappable=True, provider=self._status)
        for index, probe, edge in _VALUES:
            dictionary.add(
                index, index.title, i32, Access.READ_ONLY, mappable=True,
                provider=lambda key=(probe, edge): self._place(key),
            )  # fmt: skip
        machine.add(
            INPUTS_SUB, "Touch probe inputs", u8, mappable=True, stored=False, low=0, high=3,
            provider=lambda: self._inputs, on_write=self._take_inputs,
        )  # fmt: skip

    def _take_inputs(self, inputs: int) -> None:
        self._look()
        changed, self._inputs = self._inputs ^ inputs, inputs
        for probe in _PROBES:
            source = self._source(probe)
            if source is not _IMPULSE and changed >> source & 1:
                edge = _POSITIVE if inputs >> source & 1 else _NEGATIVE
                self._store(probe, edge, self._inner.count)

    def _part(self, probe: int) -> int:
        return self._word >> 8 * probe & 0xFF

    def _source(self, probe: int) -> int:
        """The probe whose input it looks at, or _IMPULSE."""
        told = self._part(probe) >> 2 & _SOURCES
        if told != _BY_SOURCE:
            return _IMPULSE if told == _ZERO_IMPULSE else probe
        source = self._sources[probe]
        return _IMPULSE if source in _ZERO_SOURCES else source - 1

    def _store(self, probe: int, edge: int, count: float) -> None:
        word = self._part(probe)
        if word & _ENABLED and word & edge and (word & _CONTINUOUS or not self._stored[probe] & edge):
            self._stored[probe] |= edge
            self._places[probe, edge] = self._units.position_of(count)

    def _look(self) -> None:
        """Take the zero impulses passed since the last look, then other sources and another function word."""
        before, self._count = self._count, self._inner.count
        if before != self._count:
            way = 1 if self._count > before else -1
            first, last = self._next_index(before, way), self._next_index(self._count, -way)
            if (self._count - first) * way >= 0.0:
                for probe in _PROBES:
                    if self._source(probe) is _IMPULSE:
                        last_too = self._part(probe) & _CONTINUOUS
                        for edge in (_POSITIVE, _NEGATIVE):
                            self._store(probe, edge, last if last_too else first)
        self._sources = [int(chosen.value) for chosen in self._chosen]
        if self._word != self._function.value:
            old, self._word = self._word, int(self._function.value)
            for probe in _PROBES:
                if (old ^ self._word) >> 8 * probe & _ENABLED or not self._part(probe) & _ENABLED:
                    self._stored[probe] = 0
                self._stored[probe] &= self._part(probe)

    def _status(self) -> int:
        self._look()
        return sum(
            (self._part(probe) & _ENABLED | self._stored[probe] >> _STORED_SHIFT) << 8 * probe
            for probe in _PROBES
        )

    def _place(self, key: tuple[int, int]) -> int:
        self._look()
        return self._places[key]


def _refused(word: int) -> AbortCode | None:
    """A reserved source."""
    reserved = _SOURCES in (word >> 2 & _SOURCES, word >> 10 & _SOURCES)
    return AbortCode.INVALID_VALUE if reserved else None
