"""Run a function in a separate thread, but only while its owner lets it run.

A flight in lockstep is one long call, and its simulated time advances deep inside it. To advance
several flights together, each runs in a thread that returns the baton after each step:

    owner                       thread
    resume()  --- baton --->    runs on
              <-- baton ----    pause()

Only one of the threads runs at a time, and the owner decides which one. The results therefore do
not depend on the computer's scheduler.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

R = TypeVar("R")


class CoroutineClosed(BaseException):
    """Raised inside a function to end it after its owner has closed the `ThreadCoroutine`. This is
    not an Exception, so that the function's `except Exception` clauses do not catch it."""


class ThreadCoroutine(Generic[R]):
    """Runs `function` from one `pause` to the next; the function itself calls `pause`.

    `result` is the function's return value; None until it has returned. Close the object after use,
    because a thread that waits forever keeps everything that its function refers to in memory.
    """

    def __init__(self, function: Callable[[], R], name: str) -> None:
        self._function = function
        self._baton, self._returned = threading.Semaphore(0), threading.Semaphore(0)
        self._error: BaseException | None = None
        self._closed = self._ended = False
        self.result: R | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def resume(self) -> bool:
        """Let the function run until it pauses or ends; return True if it has ended. An exception
        that the function has raised is raised again here."""
        if not self._ended:
            self._baton.release()
            self._returned.acquire()
        if self._error is not None:
            raise self._error
        return self._ended

    def pause(self) -> None:
        """Called by the function: wait for the next `resume`."""
        if not self._closed:
            self._returned.release()
            self._baton.acquire()
        if self._closed:
            raise CoroutineClosed

    def close(self) -> None:
        """End the function at its current `pause`, unless it has already ended."""
        self._closed = True
        self._baton.release()
        self._thread.join()

    def _run(self) -> None:
        self._baton.acquire()
        try:
            if not self._closed:
                self.result = self._function()
        except CoroutineClosed:
            pass
        except BaseException as error:  # `resume` raises this error in the owner's thread
            self._error = error
        self._ended = True
        self._returned.release()
