"""A certificate that nobody looks at is not drawn."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def certificates(undrawn_certificates: None) -> None:
    """None is, in all modules."""
