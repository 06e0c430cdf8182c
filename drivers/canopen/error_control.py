"""Error control between the host and a node (CiA 301 7.2.8.3.2).

heartbeat       the node watches that of the host (1016h), the host that of the node (1017h)
node guarding   for a node that lacks one of the two: the host asks for its NMT state by remote frame, and
                misses the answers; a node that is not asked for 100Ch times 100Dh takes the host for lost
                (life guarding)
"""

from typing import Final, NamedTuple

from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused
from servobench.drivers.canopen.objects301 import Cia301, object_name
from servobench.drivers.errors import TransferAborted
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant

_REQUESTS: Final = 5
"""Requests of node guarding within a time-out. A lost answer costs two: its own, and the next, whose toggle
bit then does not fit; a lost request costs one."""
_FACTOR_MAX: Final = 0xFF
"""100Dh, the life time factor, is an UNSIGNED8."""
_PROBES: Final = 3
"""On a bus that loses one frame in ten, a device that answers is missed in 1 of 150 cases."""
_PROBE: Final = Duration(20 * NS_PER_MS)
"""A remote frame is answered by the CAN controller or within a turn of the device's main loop."""


class WatchTimes(NamedTuple):
    """Times of the watch, ms."""

    node_heartbeat: int
    node_timeout: int
    """Longest silence of the node that the host accepts."""
    host_heartbeat: int
    host_timeout: int
    """Longest silence of the host that the node accepts."""


class HeldSetting(NamedTuple):
    """An object by which a node watches."""

    of_object: int
    sub: int
    code: str
    value: int


class ErrorControl:
    """Error control of one node; inactive before :meth:`begin`."""

    def __init__(self, objects: RemoteObjects) -> None:
        self._objects = objects
        self._network = objects.network
        self._node_id = objects.node_id
        self._host_watch: tuple[HeldSetting, ...] = ()
        self.told = True
        """True if the node's NMT state is received repeatedly: by heartbeat, or by guarding."""

    @property
    def host_watched(self) -> bool:
        """True if the node notices the loss of its host."""
        return bool(self._host_watch)

    def begin(self, times: WatchTimes, *, unwatched: bool) -> list[str]:
        """Make both sides watch each other; return notes on anything unusual.

        Raises SettingRefused or TransferAborted for a node that can do neither by heartbeat nor by guarding,
        unless ``unwatched`` accepts it.
        """
        objects, network = self._objects, self._network
        if not network.produces_heartbeat:
            network.produce_heartbeat(Duration(times.host_heartbeat * NS_PER_MS))
        produced = objects.read_if_there(Cia301.PRODUCER_HEARTBEAT_TIME, 0, "H") is not None
        consumes = objects.read_if_there(Cia301.CONSUMER_HEARTBEAT_TIME, 0, "B") is not None
        refusal: SettingRefused | TransferAborted | None = None
        self._host_watch = ()
        if produced and (consumes or unwatched):
            objects.write_verified(Cia301.PRODUCER_HEARTBEAT_TIME, 0, "H", times.node_heartbeat)
        if consumes:
            try:
                self._host_watch = (self._watch_host(times.host_timeout),)
            except (SettingRefused, TransferAborted) as error:
                refusal = error
        watched = bool(self._host_watch)
        guarded = not (produced and watched) and self._guard(times, produced=produced)
        if not guarded and not unwatched:
            if refusal is not None:
                raise refusal
            if not (produced and consumes):
                raise self._refused()
        if not guarded:
            network.guard(self._node_id, Duration(0))
            if produced and not watched:  # an attempt at guarding may have ended it
                objects.write_verified(Cia301.PRODUCER_HEARTBEAT_TIME, 0, "H", times.node_heartbeat)
        self.told = produced or guarded
        watch_ms = times.node_timeout if self.told else 0
        network.watch(self._node_id, Duration(watch_ms * NS_PER_MS))
        return self._notes(guarded=guarded)

    def lapses(self) -> list[str]:
        """Say where the node's watch over the host is no longer as set up."""
        texts = []
        for index, sub, code, value in self._host_watch:
            held = self._objects.read_if_there(index, sub, code)
            if held != value:
                holds = "is gone" if held is None else f"holds {held:X}h"
                texts.append(f"{object_name(index, sub)} {holds}, {value:X}h was written")
        return texts

    def end(self) -> str:
        """End the watch on both sides, so that the node does not take this for a loss.

        Returns a remark if its watch over the host had changed; else empty.
        """
        objects, network = self._objects, self._network
        network.watch(self._node_id, Duration(0))
        said = ""
        for index, sub, code, value in self._host_watch:
            held = objects.read(index, sub, code)
            objects.write(index, sub, code, 0)
            if held != value and not said:
                name = object_name(index, sub)
                wrote = f"{value:08X}h was written"
                said = f"{name} held {held:08X}h at the end, {wrote}: it did not watch the host"
        network.guard(self._node_id, Duration(0))
        return said

    # ---- inside ---------------------------------------------------------------------------------------

    def _watch_host(self, timeout_ms: int) -> HeldSetting:
        entry = consumer_entry(self._objects)
        word = self._network.node_id << 16 | timeout_ms
        setting = HeldSetting(Cia301.CONSUMER_HEARTBEAT_TIME, entry, "I", word)
        self._objects.write_verified(*setting)
        return setting

    def _guard(self, times: WatchTimes, *, produced: bool) -> bool:
        """Set up node guarding; True if the node holds 100Ch and 100Dh, and answers remote frames.

        With a heartbeat it would not answer: 1017h is cleared (CiA 301 7.2.8.3.2).
        """
        objects = self._objects
        factor = max(_REQUESTS, -(-times.host_timeout // 0xFFFF))
        guard_ms = max(1, times.host_timeout // factor)
        # Rounded down, so that the life time is no longer than was asked for.
        settings = (
            HeldSetting(Cia301.GUARD_TIME, 0, "H", guard_ms),
            HeldSetting(Cia301.LIFE_TIME_FACTOR, 0, "B", min(_FACTOR_MAX, times.host_timeout // guard_ms)),
        )
        if any(objects.read_if_there(each.of_object, each.sub, each.code) is None for each in settings):
            return False
        try:
            if produced:
                objects.write_verified(Cia301.PRODUCER_HEARTBEAT_TIME, 0, "H", 0)
            if not self._host_watch:
                for each in settings:
                    objects.write_verified(*each)
        except (SettingRefused, TransferAborted):
            return False
        if not self._answers_remote_frames():
            if not self._host_watch:
                objects.write(Cia301.LIFE_TIME_FACTOR, 0, "B", 0)
            return False
        if not self._host_watch:
            self._host_watch = settings
        self._network.guard(self._node_id, Duration(guard_ms * NS_PER_MS))
        return True

    def _answers_remote_frames(self) -> bool:
        network, status = self._network, self._network.status(self._node_id)
        for _ in range(_PROBES):
            asked_at = network.clock.now()
            network.guard(self._node_id, _PROBE)
            until = Instant(asked_at + _PROBE)
            while network.pump_one(until):
                if status.heartbeat_at is not None and status.heartbeat_at >= asked_at:
                    return True
        network.guard(self._node_id, Duration(0))
        return False

    def _refused(self) -> SettingRefused:
        lacks, why = _NOT_WATCHED[bool(self._host_watch)]
        return SettingRefused(
            f"node {self._node_id} has no {lacks}, and cannot be guarded by 100Ch and 100Dh",
            why,
            "if somebody can stop it by hand, set unwatched = true, or --unwatched",
        )

    def _notes(self, *, guarded: bool) -> list[str]:
        if guarded:
            by = "life guarding (100Ch, 100Dh)" if len(self._host_watch) > 1 else "its heartbeat (1016h)"
            return [f"1016h or 1017h is missing: the host is watched by {by}, the drive by node guarding"]
        texts = []
        if not self._host_watch:
            texts.append("1016h is missing or not taken: the drive does not notice that the host is gone")
        if not self.told:
            texts.append("1017h is missing: the host does not notice that the drive is gone")
        return texts


_NOT_WATCHED: Final = {
    False: ("1016h", "the drive does not notice that the host is gone"),
    True: ("1017h", "the host does not notice that the drive is gone"),
}
"""By which side lacks the watch: the missing object, and its consequence."""


def watch_lack(*, produced: bool, consumes: bool) -> tuple[str, str] | None:
    """Return the object whose lack keeps one side from watching the other by heartbeat, and the
    consequence."""
    return None if produced and consumes else _NOT_WATCHED[consumes]


def consumer_entry(objects: RemoteObjects) -> int:
    """Return the sub-index of 0x1016 that watches the host already, or the first free one.

    A second entry for one node is forbidden, so the first search goes first.
    """
    host = objects.network.node_id
    count = objects.read(Cia301.CONSUMER_HEARTBEAT_TIME, 0, "B")
    words = [objects.read(Cia301.CONSUMER_HEARTBEAT_TIME, sub) for sub in range(1, count + 1)]
    for sub, word in enumerate(words, start=1):
        if word >> 16 & 0x7F == host:
            return sub
    for sub, word in enumerate(words, start=1):
        if not word & 0xFFFF or not word >> 16 & 0x7F:
            return sub
    raise SettingRefused(
        f"node {objects.node_id} has no room to watch the host's heartbeat",
        f"all {count} entries of 1016h watch other nodes",
        "clear one of them",
    )
