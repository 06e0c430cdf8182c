"""Objects of nodes read by SDO repeatedly, without waiting."""

from collections.abc import Callable
from dataclasses import dataclass

from servobench.drivers.canopen.posted import PostedUpload, TransferPost
from servobench.drivers.canopen.sdo import PumpedSdoClient
from servobench.drivers.timebase import NEVER, Duration, Instant


@dataclass(frozen=True, slots=True)
class Polled:
    """An object to read, its interval, and the receiver of its bytes and the instant of their frame."""

    node_id: int
    index: int
    sub: int
    every: Duration
    told: Callable[[bytes, Instant], None]


class ObjectPoll:
    """One object while it is polled."""

    def __init__(self, polled: Polled, client: PumpedSdoClient, post: TransferPost, now: Instant) -> None:
        self.due = now
        self._polled = polled
        self._client = client
        self._post = post
        self._upload: PostedUpload | None = None

    def keep(self, now: Instant) -> None:
        """Post the next read if it is due, the previous one has ended, and nobody waits for an answer."""
        if now < self.due:
            return
        polled = self._polled
        due = Instant(self.due + polled.every)
        self.due = due if due > now else Instant(now + polled.every)
        if not self._client.busy and (self._upload is None or self._upload.done_at is not None):
            self._upload = PostedUpload(polled.node_id, polled.index, polled.sub, polled.told)
            self._post.post(self._upload)


class ObjectPolls:
    """The polls of one network, run by its pump."""

    def __init__(
        self, client_of: Callable[[int], PumpedSdoClient], post_of: Callable[[int], TransferPost]
    ) -> None:
        self._client_of = client_of
        self._post_of = post_of
        self._polls: list[ObjectPoll] = []

    @property
    def due(self) -> Instant:
        """When the next read is due."""
        return min((poll.due for poll in self._polls), default=NEVER)

    def begin(self, polled: Polled, now: Instant) -> ObjectPoll:
        """Read an object from now on, until :meth:`end`."""
        node_id = polled.node_id
        poll = ObjectPoll(polled, self._client_of(node_id), self._post_of(node_id), now)
        self._polls.append(poll)
        return poll

    def end(self, poll: ObjectPoll) -> None:
        """Stop reading it; a read under way comes to its end."""
        if poll in self._polls:
            self._polls.remove(poll)

    def keep(self, now: Instant) -> None:
        """Post the reads that are due."""
        for poll in self._polls:
            poll.keep(now)
