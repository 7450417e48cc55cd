"""Work that may hang, done by a thread of its own: a disk does not hold up the flight loop."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress

Job = Callable[[], None]


class Behind:
    """A bounded queue of jobs and the thread that does them, in order.

    What a job raises is dropped: it has to remember itself what failed."""

    def __init__(self, most: int, name: str) -> None:
        self._most = most
        self._jobs: deque[Job] = deque()
        self._changed = threading.Condition()
        self._last = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, job: Job, share: float = 1.0) -> bool:
        """False when that share of the queue is full: the job is not done."""
        with self._changed:
            if len(self._jobs) >= share * self._most or self._last:
                return False
            self._jobs.append(job)
            self._changed.notify()
        return True

    def wait(self, job: Job, timeout_s: float) -> bool:
        """One more, however many there are; whether it was done by then. Later it may be, too."""
        done = threading.Event()

        def run() -> None:
            try:
                job()
            finally:
                done.set()

        with self._changed:
            self._jobs.append(run)
            self._changed.notify()
        return done.wait(timeout_s)

    def finish(self, job: Job, timeout_s: float, late: Job) -> int:
        """One last job; waits for it. How many jobs were not done by then: 0 is all done.

        `late` is done instead of them should the thread ever get on: it frees what they held."""
        with self._changed:
            self._jobs.append(job)
            self._last = True
            self._changed.notify()
        self._thread.join(timeout_s)
        with self._changed:
            alive = self._thread.is_alive()
            left = len(self._jobs) + int(alive)
            self._jobs.clear()  # what comes too late is not done at all
            if alive:
                self._jobs.append(late)
        return left

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._jobs:
                    if self._last:
                        return
                    self._changed.wait()
                job = self._jobs.popleft()
            with suppress(Exception):  # the next one is done all the same
                job()
