"""Scenarios start hundreds of loggers, hubs, drives and workers; what these do is not what is tested.

Nor are certificates, but where a module has an ``undrawn_certificates`` of its own.
"""

import pytest


@pytest.fixture(scope="module", autouse=True)
def children(forked_children: None, undrawn_certificates: None) -> None:
    """All are forked, but where a module has a ``forked_children`` of its own."""
