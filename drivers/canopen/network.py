"""CANopen master pumped by its caller: no thread, no Notifier, no clock but the bench's.

Frames are handled only inside ``CanopenNetwork.pump`` and ``CanopenNetwork.pump_one``; whatever waits
(an SDO transfer, a drive's state change) waits by calling them. So the same code serves simulated time,
the hub and a real bus. The cyclic path has its own dispatch table in front of canopen's subscribers.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import canopen
from canopen.sdo.exceptions import SdoAbortedError, SdoError

from servobench.drivers.canopen.cob_ids import EMERGENCY, ERROR_CONTROL, SDO_ANSWER, SDO_REQUEST
from servobench.drivers.canopen.frame_pump import FramePump, Handler
from servobench.drivers.canopen.life_signs import LifeSigns
from servobench.drivers.canopen.nmt import EMERGENCIES_KEPT, Emergency, NodeStatus, parse_emergency
from servobench.drivers.canopen.nmt_states import NODE_ID_MAX, NmtCommand, NmtState
from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.canopen.polls import ObjectPoll, ObjectPolls, Polled
from servobench.drivers.canopen.posted import PostedDownload, PostedUpload, TransferPost
from servobench.drivers.canopen.sdo import (
    SDO_ATTEMPTS,
    AnswerQueue,
    BrokenOff,
    PumpedSdoClient,
    abort_text,
    written_object,
)
from servobench.drivers.canopen.write_list import NOTHING, WriteGate, WriteList
from servobench.drivers.errors import AnswersTwice, NoAnswer, TransferAborted
from servobench.drivers.timebase import NEVER, NS_PER_S, Clock, Duration, Instant
from servobench.drivers.wire.link import BusLink

CHANGE_LIMIT = Duration(NS_PER_S)
"""Time for a change of state, two heartbeats apart."""
MASTER_NODE_ID = 127
"""The highest node-ID: its heartbeat, 77Fh, gives way to those of all nodes."""
SDO_REQUESTS = range(SDO_REQUEST + 1, SDO_REQUEST + NODE_ID_MAX + 1)
SURPLUS_BORNE = 2
"""Surplus SDO answers that are ignored: an adapter may repeat a frame. Two nodes give one for each request,
and connecting takes a dozen."""


class CanopenNetwork(canopen.Network):
    """One bus with its nodes, as the master sees it.

    ``sync_count`` counts the SYNCs sent; ``emergencies`` keeps the last 10 000 EMCYs as values.
    Every method that sends or lets time pass raises BusDown if the bus is gone.
    """

    def __init__(
        self, link: BusLink, clock: Clock, node_id: int = MASTER_NODE_ID, *, writes: WriteList = NOTHING
    ) -> None:
        """``node_id``: the master's own, for its heartbeat. ``writes``: the writes by SDO allowed to it."""
        super().__init__(link.bus)
        self.link = link
        self.clock = clock
        self.node_id = node_id
        """The master's own, for its heartbeat."""
        self.emergencies: deque[Emergency] = deque(maxlen=EMERGENCIES_KEPT)
        self.emergencies_seen = 0
        self.sdo_timeout_s = 0.2
        """Wait for one answer."""
        lss: Any = self.lss
        lss.responses = AnswerQueue(self)
        self.writes = WriteGate(writes)
        """Checked before each write by SDO."""
        self._status: dict[int, NodeStatus] = {}
        self._clients: dict[int, PumpedSdoClient] = {}
        self._posts: dict[int, TransferPost] = {}
        self.polls = ObjectPolls(self._client_of, self._post)
        self.frame_pump = pump = FramePump(link, clock, self._tell_canopen, self._keep_house)
        """The pump that the cyclic path uses directly."""
        self.pump: Callable[[Instant], None] = pump.pump
        """See :meth:`FramePump.pump`."""
        self.pump_one: Callable[[Instant], bool] = pump.pump_one
        """See :meth:`FramePump.pump_one`."""
        self.send_sync: Callable[[], Instant] = pump.send_sync
        """See :meth:`FramePump.send_sync`."""
        self.life_signs = LifeSigns(link, clock, node_id)
        """The signs by which nodes watch this master; ended by :meth:`fall_silent`."""
        self.on_written: dict[int, Callable[[int, int, bytes], None]] = {}
        """Handlers by node, called for each confirmed download: index, sub-index and data."""
        self._emergency_listeners: tuple[Callable[[Emergency], None], ...] = ()
        self.on_surplus_answer: Callable[[int, bytes, Instant], None] | None = None
        """Called for an unsolicited SDO answer: node, data and instant."""

    # ---- time -----------------------------------------------------------------------------------------

    @property
    def sync_count(self) -> int:
        """SYNCs sent."""
        return self.frame_pump.sync_count

    def _tell_canopen(self, can_id: int, data: bytes, at: Instant) -> None:
        self.notify(can_id, bytearray(data), at / NS_PER_S)

    def deadline_after(self, duration: Duration) -> Instant:
        """Return the instant ``duration`` from now."""
        return Instant(self.clock.now() + duration)

    # ---- sending --------------------------------------------------------------------------------------

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        """Send a data frame of canopen's own services; ValueError for remote frames and SDO requests."""
        if remote:
            raise ValueError("the only remote frames of this master are those of its guard()")
        if can_id in SDO_REQUESTS:
            raise ValueError("SDO requests of this master go through send_request()")
        self.link.send(can_id, bytes(data))

    def send_request(self, node_id: int, request: bytes) -> Instant:
        """Send an SDO request without waiting for an answer; return its hand-over. All requests pass here.

        Raises UnlistedWrite for an object that may not be written, ValueError for a block download; then
        nothing is sent.
        """
        written = written_object(request)
        if written is not None:
            self.writes.check(node_id, *written)
        return self.link.send(SDO_REQUEST + node_id, request)

    def command(self, command: NmtCommand, node_id: int = 0) -> Instant:
        """Send an NMT command to a node; to all nodes with ``node_id`` 0 (CiA 301 7.2.8.2.1)."""
        return self.link.send(0x000, bytes((command, node_id)))

    def produce_heartbeat(self, period_ns: Duration) -> None:
        """Send the master's heartbeat (state OPERATIONAL) now and then every ``period_ns``; 0 ends it.

        The pump sends it, so a master that stops pumping stops its heartbeat, which is the purpose.
        """
        self.life_signs.beat(period_ns)
        self._keep_house(self.clock.now())

    @property
    def produces_heartbeat(self) -> bool:
        """True while the master's heartbeat is being sent."""
        return self.life_signs.heartbeat

    def guard(self, node_id: int, period_ns: Duration) -> None:
        """Request a node's NMT state now and then every ``period_ns``, by remote frame (CiA 301 7.2.8.3.2.1);
        0 ends it. The pump sends it, like the heartbeat; :meth:`status` has the answers."""
        self.status(node_id).guarded = period_ns > 0
        self.life_signs.guard(node_id, period_ns)
        self._keep_house(self.clock.now())

    def fall_silent(self) -> None:
        """End heartbeat and guarding: each node that watches this master considers it lost."""
        self.life_signs.end()
        self._plan_housekeeping()

    def withhold_life_signs(self) -> None:
        """Fall silent, as if this master were gone, until :meth:`resume_life_signs`."""
        self.life_signs.withhold()
        self._plan_housekeeping()

    def resume_life_signs(self) -> None:
        """Send heartbeat and guarding at once, and continue with them."""
        self.life_signs.resume()
        self._keep_house(self.clock.now())

    # ---- nodes ----------------------------------------------------------------------------------------

    def status(self, node_id: int) -> NodeStatus:
        """Return a node's status by its heartbeats; the first call begins to follow them."""
        known = self._status.get(node_id)
        if known is None:
            if not 1 <= node_id <= NODE_ID_MAX:
                raise ValueError(f"node id {node_id} is not in 1..127")
            known = self._status[node_id] = NodeStatus(node_id)
            self.listen(ERROR_CONTROL + node_id, known.heard)
            self.listen(EMERGENCY + node_id, lambda data, at: self._on_emergency(node_id, data, at))
        return known

    def change_nmt(
        self, node_id: int, title: str, command: NmtCommand, wanted: NmtState, heartbeat_ns: Duration
    ) -> None:
        """Send an NMT command until a later heartbeat shows its effect; raises NoAnswer if none does."""
        status = self.status(node_id)
        patience = 2 * heartbeat_ns
        deadline = self.deadline_after(Duration(CHANGE_LIMIT + 2 * patience))
        while self.clock.now() < deadline:
            sent_at = self.command(command, node_id)
            resend_at = Instant(sent_at + patience)
            while self.pump_one(resend_at):
                beat_at = status.heartbeat_at
                if status.state is wanted and beat_at is not None and beat_at > sent_at:
                    return
        seen = "no heartbeat" if status.state is None else f"its heartbeat says {status.state.name}"
        raise NoAnswer(f"{title} did not become {wanted.name}", seen, "check its supply and the cable")

    def nobody_there(self, node_id: int, title: str) -> NoAnswer:
        """Return the error for a node that answers no SDO, with the other nodes heard."""
        others = sorted(set(self.scanner.nodes) - {node_id})
        heard = (
            f"heard on the bus: nodes {', '.join(map(str, others))}" if others else "nothing heard on the bus"
        )
        if self.status(node_id).heartbeat_at is not None:
            heard = "its heartbeat is there, but it answers no SDO"
        bus = self.link.name
        cure = "check that it is powered, its node id, the bit rate and the wiring"
        if bus.startswith("hub:"):
            cure = f"start a drive there: hil simulate --bus {bus} --node {node_id}"
        return NoAnswer(f"{title} does not answer", heard, f"{cure}; hil scan --bus {bus} shows who is there")

    def watch(self, node_id: int, timeout_ns: Duration) -> None:
        """Note the node as lost (``status(node_id).lost_at``) if it is silent for longer; 0: no watch."""
        self.status(node_id).watch(timeout_ns, self.clock.now())
        self._plan_housekeeping()

    def listen(self, can_id: int, handler: Handler) -> None:
        """Have ``handler(data, at)`` take all frames of this identifier, before canopen's subscribers."""
        self.frame_pump.listen(can_id, handler)

    def unlisten(self, can_id: int) -> None:
        """Undo :meth:`listen`."""
        self.frame_pump.listen(can_id, None)

    def on_emergency(self, listener: Callable[[Emergency], None]) -> None:
        """Call ``listener`` with every EMCY from a node whose :meth:`status` is followed."""
        self._emergency_listeners = (*self._emergency_listeners, listener)

    # ---- SDO ------------------------------------------------------------------------------------------

    def upload(
        self,
        node_id: int,
        index: int,
        sub: int = 0,
        timeout_s: float | None = None,
        attempts: int = SDO_ATTEMPTS,
    ) -> bytes:
        """Read an object by SDO, expedited or segmented as the node chooses; pumps meanwhile.

        ``timeout_s`` bounds the wait for one answer, ``attempts`` the requests sent for it.
        Raises TransferAborted with the abort code, or NoAnswer.
        """
        client = self._client(node_id, timeout_s, attempts)
        try:
            return bytes(client.upload(index, sub))
        except SdoError as error:
            raise self._sdo_failure(error, node_id, "read", index, sub) from error

    def download(self, node_id: int, index: int, sub: int, data: bytes) -> None:
        """Write an object by SDO and wait for the confirmation; pumps meanwhile.

        Raises UnlistedWrite, TransferAborted with the abort code, or NoAnswer.
        """
        client = self._client(node_id)
        try:
            client.download(index, sub, data)
        except SdoError as error:
            raise self._sdo_failure(error, node_id, "write", index, sub) from error
        written = self.on_written.get(node_id)
        if written is not None:
            written(index, sub, data)

    def post_download(self, node_id: int, index: int, sub: int, data: bytes) -> PostedDownload:
        """Write 1 to 4 bytes by SDO without waiting; the pump looks after confirmation and repetition.

        Of several posts to one object that wait for their turn, the latest wins. Raises UnlistedWrite.
        """
        self.writes.check(node_id, index, sub)
        download = PostedDownload(node_id, index, sub, data)
        self._post(node_id).post(download)
        self._plan_housekeeping()
        return download

    def post_upload(self, node_id: int, index: int, sub: int, told: Callable[[bytes, Instant], None]) -> None:
        """Read 1 to 4 bytes by SDO without waiting; ``told`` is called with them, or never without an
        answer."""
        self._post(node_id).post(PostedUpload(node_id, index, sub, told))
        self._plan_housekeeping()

    def poll(self, polled: Polled) -> ObjectPoll:
        """Read an object repeatedly, by the pump, until ``polls.end``."""
        poll = self.polls.begin(polled, now := self.clock.now())
        self._keep_house(now)
        return poll

    def refuse_two(self, node_id: int) -> None:
        """Raise AnswersTwice if a node gave more answers than requested: two nodes are likely."""
        client = self._clients.get(node_id)
        if client is not None and client.answers.surplus > SURPLUS_BORNE:
            raise self._answers_twice(client, node_id)

    # ---- inside ---------------------------------------------------------------------------------------

    def connect(self, *_args: Any, **_kwargs: Any) -> "CanopenNetwork":
        """Not used: the bus exists from the start, and no Notifier thread is allowed."""
        raise TypeError("a CanopenNetwork is given its bus when it is made")

    def disconnect(self) -> None:
        """End this object's services; the bus stays open for its owner."""
        self.life_signs.end()
        self.frame_pump.housekeeping_at = NEVER

    def _post(self, node_id: int) -> TransferPost:
        post = self._posts.get(node_id)
        if post is None:
            client = self._client_of(node_id)

            def ask(request: bytes) -> Instant:
                sent_at = self.send_request(node_id, request)
                client.answers.expect(sent_at, request)
                return sent_at

            post = self._posts[node_id] = TransferPost(node_id, ask)
        return post

    def _client_of(self, node_id: int) -> PumpedSdoClient:
        client = self._clients.get(node_id)
        if client is None:
            client = self._clients[node_id] = PumpedSdoClient(self, node_id)
            self.listen(SDO_ANSWER + node_id, lambda data, at: self._on_sdo_answer(node_id, data, at))
            self.listen(SDO_REQUEST + node_id, client.on_foreign_request)
        return client

    def _client(
        self, node_id: int, timeout_s: float | None = None, attempts: int = SDO_ATTEMPTS
    ) -> PumpedSdoClient:
        """Return the node's SDO client, once its channel is free of posted transfers."""
        client = self._client_of(node_id)
        client.RESPONSE_TIMEOUT = self.sdo_timeout_s if timeout_s is None else timeout_s
        client.MAX_RETRIES = attempts
        post = self._posts.get(node_id)
        if post is None or post.in_flight is None:
            return client
        with client.taken():  # or a poll of a silent node is posted anew whenever one was given up
            while post.in_flight is not None:
                if not self.pump_one(post.in_flight.deadline):
                    self._keep_house(self.clock.now())  # at its deadline it is repeated or given up
        return client

    def _on_sdo_answer(self, node_id: int, data: bytes, at: Instant) -> None:
        client, post = self._clients[node_id], self._posts.get(node_id)
        if not client.answers.came(at, data) and self.on_surplus_answer is not None:
            self.on_surplus_answer(node_id, data, at)
        if post is None or not post.answered(data, at):
            client.on_answer(data)

    def _sdo_failure(
        self, error: SdoError, node_id: int, action: str, index: int, sub: int
    ) -> TransferAborted | NoAnswer | AnswersTwice:
        name = object_name(index, sub)
        if isinstance(error, SdoAbortedError):
            summary = f"node {node_id} on {self.link.name} refused to {action} {name}"
            return TransferAborted(summary, abort_text(error.code), code=error.code)
        client = self._clients[node_id]
        if client.answers.surplus > SURPLUS_BORNE:
            return self._answers_twice(client, node_id)
        waited_ms = client.RESPONSE_TIMEOUT * client.MAX_RETRIES * 1e3
        requests = (
            "" if isinstance(error, BrokenOff) else f" ({client.MAX_RETRIES} requests in {waited_ms:.0f} ms)"
        )
        return NoAnswer(
            f"node {node_id} on {self.link.name} did not answer the SDO {action} of {name}",
            f"{error}{requests}",
            "check node id, bit rate and wiring",
        )

    def _answers_twice(self, client: PumpedSdoClient, node_id: int) -> AnswersTwice:
        others = client.foreign_requests
        others_text = f"; another master sent {others} requests on its channel" if others else ""
        return AnswersTwice(
            f"node {node_id} on {self.link.name} sends more answers than requested",
            f"{client.answers.surplus} SDO answers too many{others_text}",
            f"two devices are likely to have the node id {node_id}: switch one of them off, "
            "give it another id, and see with hil scan who is there",
        )

    def _on_emergency(self, node_id: int, data: bytes, at: Instant) -> None:
        emergency = parse_emergency(node_id, data, at)
        if emergency is None:
            return
        self.emergencies.append(emergency)
        self.emergencies_seen += 1
        for listener in self._emergency_listeners:
            listener(emergency)

    def _keep_house(self, now: Instant) -> None:
        """Send the life signs, note lost nodes and repeat or post transfers that are due at ``now``."""
        self.life_signs.keep(now)
        for status in self._status.values():
            expires_at = status.expires_at()
            if expires_at is not None and now >= expires_at:
                status.lost_at = expires_at
        for post in self._posts.values():
            post.expire(now)
        self.polls.keep(now)
        self._plan_housekeeping()

    def _plan_housekeeping(self) -> None:
        expiries = [at for status in self._status.values() if (at := status.expires_at()) is not None]
        flying = [post.in_flight.deadline for post in self._posts.values() if post.in_flight is not None]
        self.frame_pump.housekeeping_at = min(self.life_signs.due, self.polls.due, *expiries, *flying)
