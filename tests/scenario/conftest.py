"""Scenarios start hundreds of loggers, hubs, drives and workers; what these do is not what is tested.

Nor are certificates, but where a module has an ``undrawn_certificates`` of its own, and pages of Rerun, but
where it has ``unviewed_recordings``.
"""

import pytest


@pytest.fixture(scope="module", autouse=True)
def children(forked_children: None, undrawn_certificates: None, unviewed_recordings: None) -> None:
    """All are forked, but where a module has a ``forked_children`` of its own."""
