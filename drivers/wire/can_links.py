"""The kernel's CAN interfaces with bit rate and controller state, as iproute2 tells them.

Whether an interface is there and up stands in sysfs; its bit rate and the state of its controller only in
netlink, which ``ip -json -details link`` speaks. Without that program these two are unknown.
"""

import json
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

from drivers.wire.adapters import SOCKETCAN, socketcan_links

COMMAND = ("ip", "-json", "-details", "link", "show")
_TIMEOUT_S = 5.0
_SYSFS = Path("/sys/class/net")


class CanLink(NamedTuple):
    """One CAN interface of the kernel."""

    name: str
    up: bool
    kind: str
    """``can`` for an adapter, ``vcan`` and the like for a virtual one; empty if unknown."""
    bitrate_bit_s: int | None
    """None: virtual, not set, or unknown."""
    state: str
    """Of its controller, e.g. ``ERROR-ACTIVE`` or ``BUS-OFF``; empty if unknown."""
    transmit_errors: int | None = None
    receive_errors: int | None = None
    listen_only: bool = False

    @property
    def spec(self) -> str:
        """What to hand to --bus."""
        return f"{SOCKETCAN}:{self.name}"


def can_links(root: Path = _SYSFS, described: str | None = None) -> list[CanLink]:
    """The CAN interfaces of this machine, by name; ``described``: what ``ip`` printed, asked for if None."""
    if described is None:
        described = _ask_ip()
    told = {link.name: link for link in parse_links(described)}
    links = []
    for adapter in socketcan_links(root):
        name = adapter.spec.removeprefix(f"{SOCKETCAN}:")
        links.append(told.pop(name, CanLink(name, adapter.usable, "", None, "")))
    return sorted([*links, *told.values()])


def parse_links(text: str) -> list[CanLink]:
    """The CAN interfaces in the output of ``ip -json -details link show``; none in what is not that."""
    try:
        links = json.loads(text) if text.strip() else []
    except ValueError:
        return []
    if not isinstance(links, list):
        return []
    return [_link(link) for link in links if isinstance(link, dict) and link.get("link_type") == "can"]


def _link(link: dict[str, Any]) -> CanLink:
    info = link.get("linkinfo") or {}
    data = info.get("info_data") or {}
    counters = data.get("berr_counter") or {}
    return CanLink(
        str(link.get("ifname", "")),
        "UP" in link.get("flags", ()),
        str(info.get("info_kind", "")),
        (data.get("bittiming") or {}).get("bitrate"),
        str(data.get("state", "")),
        counters.get("tx"),
        counters.get("rx"),
        "LISTEN-ONLY" in (data.get("ctrlmode") or ()),
    )


def _ask_ip() -> str:
    try:
        ended = subprocess.run(COMMAND, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return ended.stdout
