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


def write_weights(path: Path, content: dict[str, Any]) -> None:
    """Write the file. Errors: InvalidValue when it cannot be; the old one then stays."""
    text = _HEAD + yaml.safe_dump({"format": FORMAT, **content}, sort_keys=False)
    write_files({path: text.encode("utf-8")})
