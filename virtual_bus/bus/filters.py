"""python-can's acceptance filters, applied to a frame."""

from can.typechecking import CanFilters

from virtual_bus.frame import Frame


def accepts(filters: CanFilters, frame: Frame) -> bool:
    """Whether at least one filter matches: equal under its mask, and of its format if it names one."""
    for one in filters:
        if "extended" in one and one["extended"] != frame.extended:
            continue
        if not (one["can_id"] ^ frame.can_id) & one["can_mask"]:
            return True
    return False
