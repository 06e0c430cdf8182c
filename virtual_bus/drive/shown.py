"""Objects that show another value than the one that rules inside the drive."""

from virtual_bus.device.object_dictionary import Variable


def show_instead(variable: Variable, value: int) -> None:
    """What the bus reads; what rules stays. A write from the bus ends the difference."""
    held, on_write = variable.default, variable.on_write

    def wrong() -> int:
        return value if variable.value == held else int(variable.value)

    def written(new: int) -> None:
        if new == value:
            variable.value = held
        if on_write is not None:
            on_write(int(variable.value))

    variable.provider, variable.on_write = wrong, written
