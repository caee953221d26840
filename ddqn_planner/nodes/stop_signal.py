"""SIGINT and SIGTERM, which stop a node after what it does now."""

import os
import signal
import threading

from rclpy.executors import Executor

CALLBACK_PATIENCE = 0.5  # seconds that a callback may take after a signal to stop


class Interrupted(BaseException):
    """Ends a callback that runs in the main thread long after a signal to stop."""


class StopSignal:
    """The first SIGINT or SIGTERM. It ends what the main thread does."""

    def __init__(self) -> None:
        self.has_come = False
        self._is_late = False
        self.obeyed = threading.Event()
        """The main thread runs no callback any more: from now on, it saves."""

    def listen(self, executor: Executor) -> None:
        """Receive the signals from now on, and wake the executor at the first."""
        # Python's handlers run in the main thread, and not while that waits for
        # messages.
        pipe_end, signal_end = os.pipe()
        os.set_blocking(signal_end, False)
        signal.set_wakeup_fd(signal_end, warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

        def wait() -> None:
            os.read(pipe_end, 1)
            # A flag, as many requests may stand before a task; a task, as it wakes the
            # executor.
            self.has_come = True
            executor.create_task(lambda: None)
            # It may compile in a callback, or wait for a thread that does.
            while not self.obeyed.wait(CALLBACK_PATIENCE):
                self._is_late = True
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)

        threading.Thread(target=wait, daemon=True).start()

    def _on_signal(self, *_: object) -> None:
        if self._is_late and not self.obeyed.is_set():
            raise Interrupted
