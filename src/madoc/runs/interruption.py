"""Ctrl-C and SIGTERM as a request to stop, which is obeyed between two steps."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interruption:
    """A request to stop: after the first one the current step still ends, a second one breaks it off."""

    def __init__(self) -> None:
        self.asked = False
        self._breakable = False

    @contextmanager
    def breakable(self) -> Iterator[None]:
        """A block that a second request leaves with KeyboardInterrupt; no files may be written in it."""
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
    """Handle SIGINT and SIGTERM in the block, if it runs in the main thread; other threads may not."""
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
