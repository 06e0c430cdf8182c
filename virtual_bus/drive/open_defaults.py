"""Defaults that a vendor's dictionary leaves open by writing 0, and that the drive cannot move with."""

from virtual_bus.device.object_dictionary import Variable


class OpenDefaults:
    """The drive's own defaults of what it needs, as they are before a vendor's dictionary comes over them."""

    def __init__(self, *needed: Variable) -> None:
        self._own = [(variable, variable.default) for variable in needed]

    def fill_in(self, node_id: int) -> None:
        """At power-on: in the place of a default of 0 the drive's own one."""
        for variable, default in self._own:
            if not variable.default:
                variable.default = default
                variable.restore(node_id)
