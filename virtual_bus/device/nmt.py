"""NMT slave: states, commands and what follows a loss of communication.

    command             PRE-OPERATIONAL    OPERATIONAL        STOPPED
    1    start          OPERATIONAL        OPERATIONAL        OPERATIONAL
    2    stop           STOPPED            STOPPED            STOPPED
    128  pre-op         PRE-OPERATIONAL    PRE-OPERATIONAL    PRE-OPERATIONAL
    129  reset node     INITIALISING, then boot-up and PRE-OPERATIONAL, from every state
    130  reset comm.    the same, only the communication profile is reset

CiA 301, 7.2.8.2 and 7.3.2. INITIALISING takes the time that the device takes to boot; one without a
node-ID stays there until LSS gives it one.
"""

from collections.abc import Callable

from servobench.drivers.canopen import cob_ids
from servobench.drivers.canopen.cob_ids import ERROR_CONTROL
from servobench.drivers.canopen.nmt_states import NmtCommand, NmtState
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.device.station import Station
from servobench.virtual_bus.frame import Frame

TARGETS: dict[int, NmtState] = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}
"""Where a command leads that resets nothing; the same from each state."""

ERROR_BEHAVIOUR: dict[int, dict[NmtState, NmtState]] = {
    0: {NmtState.OPERATIONAL: NmtState.PRE_OPERATIONAL},
    1: {},
    2: {
        NmtState.OPERATIONAL: NmtState.STOPPED,
        NmtState.PRE_OPERATIONAL: NmtState.STOPPED,
    },
}
"""1029h: by its value, what each state becomes on an error; a state left out stays (CiA 301, 7.5.2.32)."""

StateListener = Callable[[NmtState, Instant], None]


class NmtSlave:
    """The NMT state machine; ``reset_node`` and ``reset_communication`` are the device's own."""

    def __init__(
        self,
        station: Station,
        reset_node: Callable[[Instant], None],
        reset_communication: Callable[[Instant], None],
    ) -> None:
        self._station = station
        self._resets: dict[int, Callable[[Instant], None]] = {
            NmtCommand.RESET_NODE: reset_node,
            NmtCommand.RESET_COMMUNICATION: reset_communication,
        }
        self._listeners: list[StateListener] = []
        station.listen(cob_ids.NMT, self._on_command)
        station.dictionary.hook(Cia301.ERROR_BEHAVIOUR, 1, check=_check_behaviour)

    def add_listener(self, listener: StateListener) -> None:
        """Call ``listener`` after each change of state, before the application hears of it."""
        self._listeners.append(listener)

    def enter(self, state: NmtState, now: Instant) -> None:
        """Change to ``state``; nothing happens if it is the present one."""
        station = self._station
        if state is station.state:
            return
        station.state = state
        for listener in self._listeners:
            listener(state, now)
        station.application.on_nmt(state, now)

    def boot_up(self, now: Instant) -> None:
        """INITIALISING is over: boot-up message, PRE-OPERATIONAL (CiA 301, 7.2.8.3.3)."""
        self._station.send(Frame(ERROR_CONTROL + self._station.node_id, b"\x00"))
        self.enter(NmtState.PRE_OPERATIONAL, now)

    def on_communication_error(self, now: Instant) -> None:
        """Error behaviour of 1029h:1."""
        table = ERROR_BEHAVIOUR.get(self._station.value(Cia301.ERROR_BEHAVIOUR, 1), {})
        state = self._station.state
        self.enter(table.get(state, state), now)

    def _on_command(self, frame: Frame, now: Instant) -> None:
        if self._station.state is NmtState.INITIALISING:
            # A device without a node-ID: it waits for LSS. One that boots hears nothing at all.
            return
        if len(frame.data) != 2 or frame.data[1] not in (0, self._station.node_id):
            return
        command = frame.data[0]
        if command in TARGETS:
            self.enter(TARGETS[command], now)
        elif command in self._resets:
            self._resets[command](now)


def _check_behaviour(value: int) -> AbortCode | None:
    return None if value in ERROR_BEHAVIOUR else AbortCode.INVALID_VALUE
