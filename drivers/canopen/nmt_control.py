"""Bringing a node into an NMT state, and telling what is heard of one that does not answer."""

from drivers.canopen.network import CanopenNetwork
from drivers.canopen.nmt_states import NmtCommand, NmtState
from drivers.errors import NoAnswer
from drivers.timebase import NS_PER_S, Duration, Instant

CHANGE_LIMIT = Duration(NS_PER_S)
"""Time for a change of state, two heartbeats apart."""


def change_nmt(
    network: CanopenNetwork,
    node_id: int,
    title: str,
    command: NmtCommand,
    wanted: NmtState,
    heartbeat_ns: Duration,
) -> None:
    """Send an NMT command until a later heartbeat shows its effect; raises NoAnswer if none does."""
    status = network.status(node_id)
    patience = 2 * heartbeat_ns
    deadline = network.deadline_after(Duration(CHANGE_LIMIT + 2 * patience))
    while network.clock.now() < deadline:
        sent_at = network.command(command, node_id)
        resend_at = Instant(sent_at + patience)
        while network.pump_one(resend_at):
            beat_at = status.heartbeat_at
            if status.state is wanted and beat_at is not None and beat_at > sent_at:
                return
    seen = "no heartbeat" if status.state is None else f"its heartbeat says {status.state.name}"
    raise NoAnswer(f"{title} did not become {wanted.name}", seen, "check its supply and the cable")


def nobody_there(network: CanopenNetwork, node_id: int, title: str) -> NoAnswer:
    """The error for a node that answers no SDO, with who else was heard."""
    others = sorted(set(network.scanner.nodes) - {node_id})
    heard = f"heard on the bus: nodes {', '.join(map(str, others))}" if others else "nothing heard on the bus"
    if network.status(node_id).heartbeat_at is not None:
        heard = "its heartbeat is there, but it answers no SDO"
    return NoAnswer(
        f"{title} does not answer",
        heard,
        "check that it is powered, its node id, the bit rate and the wiring; "
        f"hil scan --bus {network.link.name} shows who is there",
    )
