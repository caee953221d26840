"""SIGINT and SIGTERM, which stop a node after what it does now."""

import os
import signal
import threading

from rclpy.executors import Executor

CALLBACK_PATIENCE = 0.5  # seconds that a callback may take after a signal to stop


class Interrupted(BaseException):
    """Ends a callback that runs in the main thread long after a signal to stop."""


class StopSignal:
    """The first SIGINT or SIGTERM, and whether the main thread has obeyed it.

    The signal lets the executor end after its callback. A callback that takes longer
    than `CALLBACK_PATIENCE` is ended by `Interrupted`.
    """

    def __init__(self) -> None:
        """Begin without a signal; `listen` receives signals."""
        self.has_come = False  # whether a signal has come
        self.obeyed = threading.Event()
        """Set by the main thread when it runs no callback any more: it saves now."""
        self._interrupts = False  # whether signals raise `Interrupted`

    def listen(self, executor: Executor) -> None:
        """Receive the signals from now on, and wake the executor at the first."""
        # Python's handlers run in the main thread, and not while the executor waits
        # there for messages. So Python writes a byte into a pipe, which a thread reads.
        pipe_end, signal_end = os.pipe()
        os.set_blocking(signal_end, False)
        signal.set_wakeup_fd(signal_end, warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

        def wait() -> None:
            """Wait for the first signal, and let the main thread obey it."""
            os.read(pipe_end, 1)
            # The executor looks at the flag after each callback; a task wakes it.
            self.has_come = True
            executor.create_task(lambda: None)
            # A callback may compile for long, or wait for a thread that does.
            while not self.obeyed.wait(CALLBACK_PATIENCE):
                self._interrupts = True
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)

        threading.Thread(target=wait, daemon=True).start()

    def _on_signal(self, *_: object) -> None:
        """End the main thread's callback if the executor is late to obey the signal."""
        if self._interrupts and not self.obeyed.is_set():
            raise Interrupted
