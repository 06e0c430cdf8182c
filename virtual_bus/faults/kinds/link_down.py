"""``[[link_down]]``: the host's interface is down."""

import errno

from servobench.virtual_bus.faults.fault_table import LogKind, LogNumber
from servobench.virtual_bus.faults.node_fault import AdapterOutage


class LinkDown(AdapterOutage):
    """Somebody has set the interface down, or its cable is out: nothing is sent or heard until it is up."""

    kind = "link_down"
    logs = (LogKind("link_down", (LogNumber("duration_ns"),), "host", "nothing"),)
    code = errno.ENETDOWN
    hears = False
    begins = "is down: nothing is sent or heard"
    ends = "is up again"
