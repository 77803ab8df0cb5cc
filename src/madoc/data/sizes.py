"""How much of a file is read: its size is looked up before anything is, and a bound is said where it is refused."""

from madoc.errors import MadocError

LARGEST = 500_000_000
"""Largest size of what is read of one log, bytes in memory: four million rows of twelve numbers, and a clock."""
LARGEST_OF_ALL = 2_000_000_000
"""Largest size of what is read of all logs together, bytes in memory."""
LARGEST_DATASET = 4_000_000_000
"""Largest size of a data set of one of Madoc's own robots, bytes in memory: two million rows of an Ant have half."""


def check_size(size: int, what: str, most: int) -> None:
    """Refuse what would take more memory than a bound, bytes, before it is read."""
    if size > most:
        raise MadocError(
            f"{what} take {size:,} bytes of memory or more, at most {most:,} are read; split the log or record less"
        )
