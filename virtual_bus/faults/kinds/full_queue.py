"""``[[full_queue]]``: the host's adapter has no room for a frame."""

import errno

from servobench.virtual_bus.faults.fault_table import LogKind, LogNumber
from servobench.virtual_bus.faults.node_fault import AdapterOutage


class FullQueue(AdapterOutage):
    """The transmit queue is full, as where nobody acknowledges or another program floods the interface."""

    kind = "full_queue"
    logs = (LogKind("full_queue", (LogNumber("duration_ns"),), "host", "nothing"),)
    code = errno.ENOBUFS
