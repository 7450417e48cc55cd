"""The weights file that a profile names (`merge.weights_file`)."""

from __future__ import annotations

import os
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import yaml

from perchctl.errors import InvalidValue

FORMAT = "perchctl-merge-weights"
_HEAD = """\
# Merge weights of the large marker (the small one's are 1 - w), fitted by perchctl
# fit-weights. Named by a profile: merge: {method: weights, weights_file: THIS_FILE}
"""


def write_weights(path: Path, content: dict[str, Any]) -> Path | None:
    """Write the file; an existing one is kept aside. Returns where, or None.

    Errors: InvalidValue when it cannot be written; the old file then stays in place.
    """
    text = _HEAD + yaml.safe_dump({"format": FORMAT, **content}, sort_keys=False)
    beside = path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(text, encoding="utf-8")
        aside = _keep_aside(path)
        os.replace(beside, path)
    except OSError as error:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        raise InvalidValue(f"{path}: cannot be written: {error.strerror}") from None
    return aside


def _keep_aside(path: Path) -> Path | None:
    """Copy by a hard name: ``weights.yaml.bak1``, ``.bak2``, ... the next that is free."""
    if not path.exists():
        return None
    for number in count(1):
        aside = path.with_name(f"{path.name}.bak{number}")
        try:
            with aside.open("xb") as stream:
                stream.write(path.read_bytes())
            return aside
        except FileExistsError:
            continue
    raise AssertionError("unreachable")
