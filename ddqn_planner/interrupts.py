"""Lets Ctrl-C wait while a block runs, so that the block leaves nothing half done."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Run a block; a Ctrl-C meanwhile raises KeyboardInterrupt after the block.

    A second Ctrl-C raises it at once. Only Python's own handler of SIGINT waits: a
    program with a handler of its own keeps this handler.
    """
    is_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    if not is_main_thread or handler is not signal.default_int_handler:
        yield
        return
    has_come = False

    def note(*_: object) -> None:
        nonlocal has_come
        has_come = True
        signal.signal(signal.SIGINT, handler)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
    if has_come:
        raise KeyboardInterrupt
