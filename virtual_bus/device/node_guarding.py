"""Node guarding and life guarding: 100Ch, 100Dh (CiA 301, 7.2.8.2.1)."""

from drivers.canopen.error_codes import ErrorRegister
from drivers.canopen.nmt_states import NmtState
from drivers.timebase import NS_PER_MS, Instant
from virtual_bus.device.application import CommunicationLoss
from virtual_bus.device.emergency import EmergencyProducer
from virtual_bus.device.heartbeat import ERROR_CONTROL, HEARTBEAT_ERROR, HeartbeatProducer
from virtual_bus.device.nmt import NmtSlave
from virtual_bus.device.station import Station
from virtual_bus.frame import Frame

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
        self._lost = False
        self._can_id: int | None = None
        self._timer = station.timers.create(self._on_timeout)
        for index in (0x100C, 0x100D):
            variable = station.dictionary.get(index)
            if variable is not None:
                variable.on_write = self._on_write

    def reset_communication(self) -> None:
        """The toggle bit begins with 0 again; life guarding with the next request."""
        if self._can_id is not None:
            self._station.ignore(self._can_id, self._on_request, remote=True)
        self._can_id = ERROR_CONTROL + self._station.node_id
        self._station.listen(self._can_id, self._on_request, remote=True)
        self._toggle = 0
        self._lost = False
        self._timer.stop()

    @property
    def _life_time_ns(self) -> int:
        return self._station.value(0x100C) * self._station.value(0x100D) * NS_PER_MS

    def _on_write(self, _value: int) -> None:
        self._timer.stop()

    def _on_request(self, _frame: Frame, now: Instant) -> None:
        if self._heartbeat.running or self._station.state is NmtState.INITIALISING:
            return
        station = self._station
        station.out.append(Frame(ERROR_CONTROL + station.node_id, bytes([station.state | self._toggle])))
        self._toggle ^= 0x80
        if self._life_time_ns:
            self._timer.start(Instant(now + self._life_time_ns))
        if self._lost:
            self._lost = False
            self._emergency.clear_error(HEARTBEAT_ERROR, _SOURCE)
            station.application.on_communication_restored(CommunicationLoss.LIFE_GUARDING, 0, now)

    def _on_timeout(self, now: Instant) -> None:
        if self._heartbeat.running:
            return
        self._lost = True
        self._emergency.raise_error(HEARTBEAT_ERROR, ErrorRegister.COMMUNICATION, source=_SOURCE)
        self._station.application.on_communication_loss(CommunicationLoss.LIFE_GUARDING, 0, now)
        self._nmt.on_communication_error(now)
