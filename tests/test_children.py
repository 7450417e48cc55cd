"""What a process of perchctl's own loads before it can end with its parent."""

from __future__ import annotations

import os
import subprocess
import sys

from tests.helpers.flights import ROOT


def test_the_watch_over_the_parent_loads_no_library() -> None:
    """A busy computer takes half a minute to load them all, and a parent may be gone by then."""
    code = (
        "import pickle, sys; from perchctl.children import end_with_parent; "
        "pickle.loads(pickle.dumps(end_with_parent)); "
        "print(sorted({'numpy', 'cv2', 'mujoco', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60.0,
    )
    assert done.stdout == "[]\n", done.stderr
