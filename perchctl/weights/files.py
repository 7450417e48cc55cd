"""The weights file that a profile names (`merge.weights_file`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from perchctl.files import write_files

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
    return write_files({path: text.encode("utf-8")}, make_folders=True, keep_old=True).get(path)
