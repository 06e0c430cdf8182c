"""Who watches whose heartbeat: 1016h and 1017h of a drive (CiA 301 7.5.2.19, 7.5.2.20)."""

from typing import NamedTuple

from drivers.canopen.objects import RemoteObjects, SettingRefused
from drivers.canopen.sdo import object_name
from drivers.errors import TransferAborted

CONSUMER_HEARTBEAT_TIME = 0x1016
PRODUCER_HEARTBEAT_TIME = 0x1017


class HostWatch(NamedTuple):
    """The entry of 0x1016 by which a drive watches the host."""

    sub: int
    word: int
    """Node-ID in bits 16 to 22, time-out in ms below (CiA 301 7.5.2.19)."""


class Heartbeats(NamedTuple):
    """Who watches whom."""

    host_watch: HostWatch | None
    """None: the drive cannot watch the host."""
    produced: bool
    """The drive sends a heartbeat."""

    @property
    def notes(self) -> list[str]:
        """What is not watched."""
        return _unwatched(watched=self.host_watch is not None, produced=self.produced)


def _unwatched(*, watched: bool, produced: bool) -> list[str]:
    found = []
    if not watched:
        found.append("1016h is missing or not taken: the drive does not notice that the host is gone")
    if not produced:
        found.append("1017h is missing: the host does not notice that the drive is gone")
    return found


def write_heartbeats(
    objects: RemoteObjects, period_ms: int, host_timeout_ms: int, *, unwatched: bool
) -> Heartbeats:
    """0x1017 gets ``period_ms``, and 0x1016 an entry for a host that is silent for ``host_timeout_ms``.

    Both are needed, unless ``unwatched`` bears a drive without: raises SettingRefused or TransferAborted if
    the drive has them not, or does not take them.
    """
    produced = objects.read_if_there(PRODUCER_HEARTBEAT_TIME, 0, "H") is not None
    watched = objects.read_if_there(CONSUMER_HEARTBEAT_TIME, 0, "B") is not None
    if not (produced and watched) and not unwatched:
        raise SettingRefused(
            f"node {objects.node_id} has no {'1017h' if watched else '1016h'}",
            "; ".join(_unwatched(watched=watched, produced=produced)),
            "if somebody can stop it by hand, say so: unwatched = true",
        )
    if produced:
        objects.write_verified(PRODUCER_HEARTBEAT_TIME, 0, "H", period_ms)
    if not watched:
        return Heartbeats(None, produced)
    try:
        return Heartbeats(_watch_host(objects, host_timeout_ms), produced)
    except (SettingRefused, TransferAborted):
        if unwatched:
            return Heartbeats(None, produced)
        raise


def _watch_host(objects: RemoteObjects, host_timeout_ms: int) -> HostWatch:
    """Have the drive watch the host."""
    entry = consumer_entry(objects)
    word = objects.network.node_id << 16 | host_timeout_ms
    objects.write_verified(CONSUMER_HEARTBEAT_TIME, entry, "I", word)
    return HostWatch(entry, word)


def consumer_entry(objects: RemoteObjects) -> int:
    """Sub-index of 0x1016 that watches the host already, or the first that watches nobody.

    A second entry for one node is forbidden, so the first search goes first.
    """
    host = objects.network.node_id
    count = objects.read(CONSUMER_HEARTBEAT_TIME, 0, "B")
    words = [objects.read(CONSUMER_HEARTBEAT_TIME, sub) for sub in range(1, count + 1)]
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


def forget_host(objects: RemoteObjects, watch: HostWatch) -> str:
    """Have the drive watch the host no more, so that it takes no leave for a loss.

    What is to be said if it did not watch it as it was told to; else empty.
    """
    held = objects.read(CONSUMER_HEARTBEAT_TIME, watch.sub)
    objects.write(CONSUMER_HEARTBEAT_TIME, watch.sub, "I", 0)
    if held == watch.word:
        return ""
    name = object_name(CONSUMER_HEARTBEAT_TIME, watch.sub)
    return f"{name} held {held:08X}h at the end, {watch.word:08X}h was written: it did not watch the host"
