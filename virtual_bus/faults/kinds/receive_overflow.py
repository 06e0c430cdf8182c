"""``[[receive_overflow]]``: the kernel drops what comes to the host."""

from servobench.virtual_bus.faults.fault_table import LogKind, LogNumber
from servobench.virtual_bus.faults.node_fault import AdapterOutage


class ReceiveOverflow(AdapterOutage):
    """The receive buffer of the socket is full, as where frames come faster than a host fetches them that
    stands still: what comes is dropped, echoes among it, and its number is told afterwards."""

    kind = "receive_overflow"
    logs = (LogKind("receive_overflow", (LogNumber("duration_ns"),), "host", "nothing"),)
    hears = False
    ends = "dropped {unheard} frames: they came faster than they were fetched"
