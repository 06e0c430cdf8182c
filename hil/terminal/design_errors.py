"""A design that fails, as the bad input that it is for somebody who typed a command."""

from design.errors import DesignError
from drivers.errors import BadInput
from hil.current_control import CurrentRequest, CurrentResult, design_current


def designed(request: CurrentRequest) -> CurrentResult:
    """The design. Raises BadInput, which carries the assumption or demand that failed and its remedy."""
    try:
        return design_current(request)
    except DesignError as error:
        raise BadInput(f"axis {request.axis}", "", str(error), "a design that exists") from error
