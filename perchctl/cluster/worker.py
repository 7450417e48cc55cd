"""What a worker of the cluster runs."""

from __future__ import annotations

import pickle
from typing import Any

from distributed import get_worker

from perchctl.cluster.wanted import Answer, Wanted, answer_to
from perchctl.errors import InvalidValue
from perchctl.flight import run_order

_asked: dict[str, Answer] = {}


def asked_first(wanted: Wanted, dask_worker: Any = None) -> Answer:
    """Before the first flight, of each worker that is there. The file that it leaves in the folder
    is for who asks to look at, and to take away."""
    name = f".{wanted.campaign}-{dask_worker.id}"
    answer = answer_to(wanted, dask_worker.state.nthreads, name)
    if answer.problem is None:
        _asked[wanted.campaign] = answer
    return answer


def fly_order(order: bytes, wanted: Wanted) -> bytes:
    """One flight; on a worker that came later it is asked now. Returns what
    `perchctl.flight.hands.run_order` does."""
    worker = get_worker()
    answer = _asked.get(wanted.campaign)
    if answer is None:
        answer = answer_to(wanted, worker.state.nthreads)
        _asked[wanted.campaign] = answer
    if answer.problem is not None:
        told = unfit(worker.address, answer)
        return pickle.dumps((False, InvalidValue(told)))
    return run_order(order)


def unfit(address: str, answer: Answer) -> str:
    """One sentence."""
    return f"worker {address} on {answer.host} {answer.problem}"
