"""What a commissioning wrote to the drive, object by object: by name, in decimal and with its unit."""

from typing import Any

from servobench.hil.commissioning.findings import Findings
from servobench.hil.reviewing.trace.node_objects import NodeObjects


def changed_objects(findings: Findings) -> list[dict[str, Any]]:
    """In the order of the objects: what each held and what it holds, as bytes, and in words.

    Names, types and units are those of the standard and of what the drive told of itself.
    """
    objects = NodeObjects()
    for (index, sub), value in findings.dump.items():
        objects.take(index, sub, value)
    changes = []
    for key, value in sorted(findings.settings.items(), key=lambda item: str(item[0])):
        before = findings.originals.get(key, b"")
        held, holds = (objects.value(key.index, key.sub, each) for each in (before, value))
        changes.append(
            {
                "object": str(key),
                "name": holds.name,
                "before": before.hex(),
                "set": value.hex(),
                "before_told": held.shown if before else "",
                "set_told": holds.shown,
            }
        )
    return changes
