"""Ctrl-C and SIGTERM as a wish to stop, heard between two steps."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interruption:
    """The user's wish to stop: asked for once, the step ends; asked for again, it breaks off."""

    def __init__(self) -> None:
        self.asked = False
        self._breakable = False

    @contextmanager
    def breakable(self) -> Iterator[None]:
        """A block that a second wish leaves with KeyboardInterrupt; files are never written in one."""
        self._breakable = True
        try:
            yield
        finally:
            self._breakable = False

    def ask(self, number: int, frame: FrameType | None) -> None:
        """The signal handler."""
        if self.asked and self._breakable:
            raise KeyboardInterrupt
        self.asked = True


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Take over SIGINT and SIGTERM, and give them back. Only the main thread may; others do nothing."""
    interruption = Interruption()
    previous = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, interruption.ask)
    try:
        yield interruption
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
