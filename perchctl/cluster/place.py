"""Where the flights of a campaign go: the ADDRESS of `--cluster`."""

from __future__ import annotations

import re
from dataclasses import dataclass

from perchctl.errors import UsageError

MOST_LOCAL = 1024
_FORM = re.compile(r"(tcp|tls|ws|wss)://([^\s/:]+|\[[0-9a-fA-F:.]+\]):([0-9]{1,5})")


@dataclass(frozen=True)
class Place:
    """`address`: of a scheduler that runs; None where `workers` are started here with one."""

    address: str | None
    workers: int = 0

    def __str__(self) -> str:
        return self.address or f"local:{self.workers}"


def parse_address(text: str) -> Place:
    """Of ``local:N``, ``HOST:PORT`` or ``tcp://HOST:PORT``. Errors: UsageError."""
    kind, _, number = text.partition(":")
    if kind == "local":
        if number.isascii() and number.isdigit() and 1 <= int(number[:9]) <= MOST_LOCAL:
            return Place(None, int(number))
        raise UsageError(
            f"--cluster {text} must be local:N with N from 1 to {MOST_LOCAL} workers, as in "
            f"--cluster local:4"
        )
    found = _FORM.fullmatch(text if "://" in text else f"tcp://{text}")
    if found is None or not 1 <= int(found[3]) <= 65535:
        raise UsageError(
            f"--cluster {text} must be the address of a dask scheduler, as in "
            f"--cluster tcp://10.0.0.5:8786, or local:N"
        )
    return Place(found[0])
