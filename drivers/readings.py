"""TPDOs of one drive put together into readings in SI units."""

from typing import Final

from drivers.exchange import Reading
from drivers.network import CanopenNetwork
from drivers.objects402 import Object
from drivers.pdo import EVERY_SYNC, HIGH_RESOLUTION_TIME_STAMP, PdoMap, PdoPlan
from drivers.scaling import Scaling
from drivers.timebase import NS_PER_S, NS_PER_US, Duration, Instant

_WORD: Final = 1 << 32
_HALF_WORD: Final = 1 << 31
_SELDOM: Final = -1
"""Mark of a TPDO that delays no reading."""

_new: Final = tuple.__new__
_READING: Final = Reading
"""``_new(_READING, values)`` takes a third of the time of ``Reading(*values)``."""


class Seen:
    """The last statusword that a drive told, by whatever way it came."""

    __slots__ = ("statusword",)

    def __init__(self) -> None:
        self.statusword = -1
        """0x6041, raw; -1 before the first."""


class ReadingAssembler:
    """Collects the synchronous TPDOs of a drive; a reading is complete with the one of lowest priority.

    The TPDOs of one SYNC arrive in the order of their identifiers, one after the other. A set is dropped and
    counted when it mixes two SYNCs, which happens when frames of both are lost:

        SYNC k: TPDO1 arrives, TPDO2 lost        SYNC k+1: TPDO1 lost, TPDO2 arrives

    A set certainly is of one SYNC if, since the last complete set, as many of its first TPDOs arrived as
    periods went by on the drive's own clock. Otherwise, and for a drive without that clock, it is taken for
    one if its frames arrived within half a period.

    A TPDO that comes only with every n-th SYNC delays no reading. If the position travels in such a one, it
    is carried along by the speed in between:

        SYNC          k          k+1        k+2        ...  k+n
        TPDO1         speed      speed      speed           speed
        TPDO2         position                              position
        reading       carried    + speed T  + speed T  ...  carried

    and a time stamp that does not come with every reading is not used.
    """

    __slots__ = (
        "_carried_rad",
        "_carrier",
        "_carries",
        "_expected",
        "_first_at",
        "_firsts",
        "_half_period_ns",
        "_network",
        "_period_s",
        "_period_us",
        "_places",
        "_position",
        "_position_raw",
        "_pump",
        "_readings",
        "_seen",
        "_stamp_raw",
        "_stamp_us",
        "_syncs",
        "_told",
        "_values",
        "incoherent",
        "incomplete",
        "malformed",
        "scaling",
    )

    def __init__(
        self, network: CanopenNetwork, plan: PdoPlan, scaling: Scaling, period_ns: Duration, told: Seen
    ) -> None:
        self.scaling = scaling
        self.incomplete = 0
        """Sets of which an earlier TPDO is missing."""
        self.incoherent = 0
        """Sets that mix two SYNCs."""
        self.malformed = 0
        """PDOs of a length other than mapped."""
        self._network = network
        self._pump = network.frame_pump
        self._told = told
        self._half_period_ns = period_ns // 2
        self._period_us = max(1, period_ns // NS_PER_US)
        self._period_s = period_ns / NS_PER_S
        self._readings: list[Reading] = []
        self._values: list[int] = []
        self._seen = self._expected = self._firsts = 0
        self._first_at = Instant(0)
        self._position = self._stamp_us = 0
        self._position_raw: int | None = None
        self._stamp_raw: int | None = None
        self._carried_rad = 0.0
        self._syncs = self._pump.sync_count
        each = sorted(_with_each_sync(plan), key=lambda pdo: pdo.cob_id)
        seldom = [pdo for pdo in plan.tpdos if pdo not in each]
        self._places = self._subscribe(each, seldom)
        self._carries = not any(pdo.place_of(Object.POSITION_ACTUAL_VALUE) is not None for pdo in each)

    def take(self) -> list[Reading]:
        """The readings completed since the last call, oldest first."""
        taken = self._readings
        if taken:
            self._readings = []
        return taken

    def anchor_position(self, raw: int) -> None:
        """0x6064 as the drive tells it now: what positions are carried on from."""
        self._unwrap_position(raw)
        self._carried_rad = 0.0
        self._syncs = self._pump.sync_count

    def frame_arrived(self, bit: int, at: Instant) -> None:
        """A TPDO of a reading arrived, the one of ``bit``; 0: the last of its SYNC."""
        if not bit:
            self._complete(at)
            return
        self._seen |= bit
        if bit == 1:
            self._firsts += 1
            self._first_at = at

    def _subscribe(self, each: list[PdoMap], seldom: list[PdoMap]) -> tuple[int, int, int, int, int]:
        """Give each PDO its slice of the values; the places of the five values of a reading among them."""
        places: dict[tuple[int, int], int] = {}
        last = len(each) - 1
        for number, pdo in enumerate(each + seldom):
            low = len(self._values)
            self._values.extend([0] * len(pdo.entries))
            for offset, entry in enumerate(pdo.entries):
                places.setdefault((entry.index, entry.sub), low + offset)
            bit = _SELDOM if number > last else 0 if number == last else 1 << number
            inlet = _Inlet(self, pdo, self._values, low, bit, self._told)
            self._network.listen(pdo.cob_id, inlet.take)
        self._expected = (1 << last) - 1
        wanted = (
            Object.STATUSWORD,
            Object.POSITION_ACTUAL_VALUE,
            Object.VELOCITY_ACTUAL_VALUE,
            Object.TORQUE_ACTUAL_VALUE,
        )
        if (Object.TORQUE_ACTUAL_VALUE, 0) not in places:
            # The current stands for it, in thousandths of its own rating; without that it reads as 0.
            spare = places.get((Object.CURRENT_ACTUAL_VALUE, 0), len(self._values))
            places[Object.TORQUE_ACTUAL_VALUE, 0] = spare
            self._values.append(0)
        missing = [f"{index:04X}h" for index in wanted if (index, 0) not in places]
        if missing:
            raise ValueError(f"the PDO plan lacks {', '.join(missing)}")
        status, position, velocity, torque = (places[index, 0] for index in wanted)
        stamped = any(pdo.place_of(HIGH_RESOLUTION_TIME_STAMP) is not None for pdo in each)
        stamp = places[HIGH_RESOLUTION_TIME_STAMP, 0] if stamped else -1
        return status, position, velocity, torque, stamp

    def _complete(self, at: Instant) -> None:
        """The last TPDO of a set arrived: build the reading, or count why there is none."""
        status, position, velocity, torque, stamp = self._places
        values = self._values
        periods = 0
        device_time_ns = None
        if stamp >= 0:
            passed_us = self._unwrap_stamp(values[stamp])
            device_time_ns = self._stamp_us * NS_PER_US
            periods = (passed_us + self._period_us // 2) // self._period_us
        if self._carries:
            self._carry_position(values[velocity])
        else:
            self._unwrap_position(values[position])
        firsts, self._firsts = self._firsts, 0
        seen, self._seen = self._seen, 0
        if seen != self._expected:
            self.incomplete += 1
            return
        if seen and firsts != periods and at - self._first_at > self._half_period_ns:
            self.incoherent += 1
            return
        scaling = self.scaling
        self._readings.append(
            _new(
                _READING,
                (
                    self._pump.sync_count,
                    self._position * scaling.position_rad + self._carried_rad,
                    values[velocity] * scaling.velocity_rad_s,
                    values[torque] * scaling.torque_nm,
                    values[status],
                    device_time_ns,
                    at,
                ),
            )
        )

    def _carry_position(self, velocity_raw: int) -> None:
        """Add what the shaft turned since the reading before, at this speed."""
        syncs = self._pump.sync_count
        self._carried_rad += (
            (syncs - self._syncs) * self._period_s * velocity_raw * self.scaling.velocity_rad_s
        )
        self._syncs = syncs

    def _unwrap_stamp(self, raw: int) -> int:
        """Microseconds since the stamp before, 0 for the first; negative if the drive's clock was set back.

        0x1013 counts modulo 2^32, which is 71.6 minutes.
        """
        if self._stamp_raw is None:
            self._stamp_us = raw
            passed = 0
        else:
            passed = ((raw - self._stamp_raw + _HALF_WORD) % _WORD) - _HALF_WORD
            self._stamp_us += passed
        self._stamp_raw = raw
        return passed

    def _unwrap_position(self, raw: int) -> None:
        """0x6064 is an INTEGER32: at 65536 counts a turn it wraps after 22 minutes of 1500 rev/min."""
        if self._position_raw is None:
            self._position = raw
        else:
            self._position += ((raw - self._position_raw + _HALF_WORD) % _WORD) - _HALF_WORD
        self._position_raw = raw


class _Inlet:
    """Takes the frames of one TPDO into its slice of an assembler's values."""

    __slots__ = (
        "_assembler",
        "_bit",
        "_low",
        "_position",
        "_size",
        "_status",
        "_told",
        "_unpack",
        "_values",
    )

    def __init__(
        self, assembler: ReadingAssembler, pdo: PdoMap, values: list[int], low: int, bit: int, told: Seen
    ) -> None:
        """``bit``: its mark in the set of a SYNC, 0 for the one that completes it, -1 outside any set."""
        codec = pdo.codec()
        self._assembler = assembler
        self._unpack = codec.unpack
        self._size = codec.size
        self._values = values
        self._low = low
        self._bit = bit
        self._told = told
        status, position = pdo.place_of(Object.STATUSWORD), pdo.place_of(Object.POSITION_ACTUAL_VALUE)
        self._status = -1 if status is None else status
        self._position = -1 if position is None else position

    def take(self, data: bytes, at: Instant) -> None:
        if len(data) != self._size:
            self._assembler.malformed += 1
            return
        fields = self._unpack(data)
        place, values = self._low, self._values
        for value in fields:
            values[place] = value
            place += 1
        if self._status >= 0:
            self._told.statusword = fields[self._status]
        if self._bit != _SELDOM:
            self._assembler.frame_arrived(self._bit, at)
        elif self._position >= 0:
            self._assembler.anchor_position(fields[self._position])


def _with_each_sync(plan: PdoPlan) -> list[PdoMap]:
    """The TPDOs that make up a reading; of a plan without any such, all."""
    return [pdo for pdo in plan.tpdos if pdo.transmission_type == EVERY_SYNC] or list(plan.tpdos)
