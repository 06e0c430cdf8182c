"""How much may still come: answers to requests, PDOs to SYNCs. What comes beyond that, nobody asked for."""


class Owed:
    """An account of what is due.

    It never blames what is only late, unless it is later than ``due_max`` others; and what was lost hides as
    much that nobody asked for, up to ``due_max``.
    """

    __slots__ = ("due", "due_max", "surplus")

    def __init__(self, due_max: int) -> None:
        self.due = 0
        self.due_max = due_max
        """What has not come by the time that so much more is due is taken for lost."""
        self.surplus = 0
        """What came beyond what was due, so far."""

    def expect(self, count: int = 1) -> None:
        """So much more is due."""
        self.due = min(self.due + count, self.due_max)

    def came(self, count: int = 1) -> int:
        """So much has come; how much of it was not due."""
        beyond = max(0, count - self.due)
        self.due = max(0, self.due - count)
        self.surplus += beyond
        return beyond
