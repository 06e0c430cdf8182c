"""Who commissions, and where: what a certificate says beside the figures."""

from pathlib import Path

from servobench.drivers.bounded_file import NamedBy
from servobench.hil.configuration.config_files import Section, load_file


class Laboratory(Section):
    """``--lab FILE``: who commissions, and where."""

    operator: str | None = None
    """Name of the operator."""
    site: str | None = None
    """Place and test stand."""
    order: str | None = None
    """Number of the order or of the device under test."""


def load_laboratory(path: Path | None, operator: str | None, site: str | None) -> Laboratory:
    """Return the file's content; ``operator`` and ``site`` go before it. Raises BadInput or BadInputs."""
    found = Laboratory()
    if path is not None:
        found = load_file(Laboratory, path, "a file of --lab", NamedBy("--lab", "", str(path)))
    given = {"operator": operator, "site": site}
    return found.model_copy(update={key: text for key, text in given.items() if text is not None})
