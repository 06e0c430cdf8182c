"""Error control (CiA 301, 7.2.8.2): heartbeat producer 1017h and consumers 1016h, node and life guarding
100Ch and 100Dh.
"""

from servobench.drivers.canopen.cob_ids import ERROR_CONTROL
from servobench.drivers.canopen.error_codes import HEARTBEAT_ERROR, ErrorRegister
from servobench.drivers.canopen.nmt_states import NODE_ID_MAX, NmtState
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.device.emergency import EmergencyProducer
from servobench.virtual_bus.device.nmt import NmtSlave
from servobench.virtual_bus.device.object_dictionary import Check, Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.device.station import CommunicationLoss, Station
from servobench.virtual_bus.frame import Frame


class HeartbeatProducer:
    """Tells the NMT state every 1017h ms; the boot-up message counts as the first."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._period_ns = 0
        self._due = Instant(0)
        self._timer = station.timer(self._on_due)
        station.dictionary.hook(Cia301.PRODUCER_HEARTBEAT_TIME, on_write=self._on_write)

    @property
    def running(self) -> bool:
        """True while heartbeats are sent, so that node guarding is not served."""
        return self._period_ns > 0

    def on_state(self, state: NmtState, _now: Instant) -> None:
        """A device that boots tells nothing until it has."""
        if state is NmtState.INITIALISING:
            self._timer.stop()

    def reset_communication(self) -> None:
        """Take the period from the dictionary; called when the boot-up message is about to be sent."""
        self._period_ns = self._station.value(Cia301.PRODUCER_HEARTBEAT_TIME) * NS_PER_MS
        self._timer.stop()
        if self._station.node_id > NODE_ID_MAX:
            self._period_ns = 0
        if self._period_ns:
            self._schedule(self._station.now)

    def _on_write(self, milliseconds: int) -> None:
        # 7.2.8.2.2: the protocol begins at once when the time is set.
        self._period_ns = milliseconds * NS_PER_MS
        self._timer.stop()
        if self._period_ns:
            self._due = self._station.now
            self._on_due(self._station.now)

    def _schedule(self, previous: Instant) -> None:
        """One period after ``previous``; after a gap go on from now, without a burst."""
        due, now = previous + self._period_ns, self._station.now
        self._due = Instant(due if due > now else now + self._period_ns)
        self._timer.start(self._due)

    def _on_due(self, _now: Instant) -> None:
        station = self._station
        station.send(Frame(ERROR_CONTROL + station.node_id, bytes([station.state])))
        self._schedule(self._due)


class HeartbeatConsumer:
    """Watches one node, from its first heartbeat on; one sub-index of 1016h."""

    def __init__(
        self, station: Station, emergency: EmergencyProducer, nmt: NmtSlave, variable: Variable
    ) -> None:
        self._station = station
        self._emergency = emergency
        self._nmt = nmt
        self._variable = variable
        self._listening: int | None = None
        self._timeout_ns = 0
        self._timer = station.timer(self._on_timeout)
        variable.on_write = self._on_write

    @property
    def node_id(self) -> int:
        """The node that is watched; 0 for none."""
        value = int(self._variable.value)
        return value >> 16 & 0xFF if value & 0xFFFF else 0

    def reset_communication(self) -> None:
        """Take the setting from the dictionary; monitoring begins with the next heartbeat."""
        self._configure()

    def _on_write(self, _value: int) -> None:
        self._emergency.clear_error(HEARTBEAT_ERROR, self._watched)
        self._configure()

    @property
    def _watched(self) -> int:
        return 0 if self._listening is None else self._listening - ERROR_CONTROL

    def _configure(self) -> None:
        if self._listening is not None:
            self._station.ignore(self._listening, self._on_heartbeat)
        self._timer.stop()
        node_id = self.node_id
        self._timeout_ns = (int(self._variable.value) & 0xFFFF) * NS_PER_MS
        self._listening = ERROR_CONTROL + node_id if 1 <= node_id <= NODE_ID_MAX else None
        if self._listening is not None:
            self._station.listen(self._listening, self._on_heartbeat)

    def _on_heartbeat(self, frame: Frame, now: Instant) -> None:
        if len(frame.data) != 1:
            return
        self._timer.start(Instant(now + self._timeout_ns))
        self._emergency.clear_error(HEARTBEAT_ERROR, self._watched)

    def _on_timeout(self, now: Instant) -> None:
        node_id = self._watched
        self._emergency.raise_error(
            HEARTBEAT_ERROR, ErrorRegister.COMMUNICATION, bytes([node_id]), source=node_id
        )
        self._station.application.on_communication_loss(CommunicationLoss.HEARTBEAT, node_id, now)
        self._nmt.on_communication_error(now)


class HeartbeatConsumers:
    """All sub-indices of 1016h."""

    def __init__(self, station: Station, emergency: EmergencyProducer, nmt: NmtSlave) -> None:
        self._station = station
        self._consumers: list[HeartbeatConsumer] = []
        if Cia301.CONSUMER_HEARTBEAT_TIME not in station.dictionary:
            return
        for subindex, variable in station.dictionary.object(Cia301.CONSUMER_HEARTBEAT_TIME).members.items():
            if subindex:
                consumer = HeartbeatConsumer(station, emergency, nmt, variable)
                self._consumers.append(consumer)
                variable.check = self._checker(consumer)

    def reset_communication(self) -> None:
        """Take all settings from the dictionary."""
        for consumer in self._consumers:
            consumer.reset_communication()

    def _checker(self, own: HeartbeatConsumer) -> Check:
        def check(value: int) -> AbortCode | None:
            """7.5.2.19: one consumer time for a node, else 06040043h; bits 24..31 are reserved, and no node
            hears its own heartbeat."""
            node_id, milliseconds = value >> 16, value & 0xFFFF
            if not milliseconds or not node_id:
                return None
            if node_id > NODE_ID_MAX or node_id == self._station.node_id:
                return AbortCode.INVALID_VALUE
            taken = any(other is not own and other.node_id == node_id for other in self._consumers)
            return AbortCode.PARAMETER_INCOMPATIBLE if taken else None

        return check


_SOURCE = 0x100
"""Beyond every node-ID: tells life guarding from the lost heartbeats, which share its error code."""


class NodeGuarding:
    """Answers the master's remote request, and watches that it comes; silent while heartbeats are on."""

    def __init__(
        self, station: Station, emergency: EmergencyProducer, nmt: NmtSlave, heartbeat: HeartbeatProducer
    ) -> None:
        self._station = station
        self._emergency = emergency
        self._nmt = nmt
        self._heartbeat = heartbeat
        self._toggle = 0
        self._can_id: int | None = None
        self._timer = station.timer(self._on_timeout)
        for index in (Cia301.GUARD_TIME, Cia301.LIFE_TIME_FACTOR):
            station.dictionary.hook(index, on_write=self._on_write)

    def reset_communication(self) -> None:
        """The toggle bit begins with 0 again; life guarding with the next request."""
        if self._can_id is not None:
            self._station.ignore(self._can_id, self._on_request, remote=True)
        self._can_id = ERROR_CONTROL + self._station.node_id
        self._station.listen(self._can_id, self._on_request, remote=True)
        self._toggle = 0
        self._timer.stop()

    @property
    def _life_time_ns(self) -> int:
        value = self._station.value
        return value(Cia301.GUARD_TIME) * value(Cia301.LIFE_TIME_FACTOR) * NS_PER_MS

    def _on_write(self, _value: int) -> None:
        self._timer.stop()

    def _on_request(self, _frame: Frame, now: Instant) -> None:
        if self._heartbeat.running or self._station.state is NmtState.INITIALISING:
            return
        station = self._station
        station.send(Frame(ERROR_CONTROL + station.node_id, bytes([station.state | self._toggle])))
        self._toggle ^= 0x80
        if self._life_time_ns:
            self._timer.start(Instant(now + self._life_time_ns))
        self._emergency.clear_error(HEARTBEAT_ERROR, _SOURCE)

    def _on_timeout(self, now: Instant) -> None:
        if self._heartbeat.running:
            return
        self._emergency.raise_error(HEARTBEAT_ERROR, ErrorRegister.COMMUNICATION, source=_SOURCE)
        self._station.application.on_communication_loss(CommunicationLoss.LIFE_GUARDING, 0, now)
        self._nmt.on_communication_error(now)
