"""What a process of perchctl's own loads before it can end with its parent, and its connection."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.helpers.flights import ROOT


def loaded(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60.0,
    )
    return done.stdout or done.stderr


def test_the_watch_over_the_parent_loads_no_library() -> None:
    """A busy computer takes half a minute to load them all, and a parent may be gone by then."""
    code = (
        "import pickle, sys; from perchctl.children import end_with_parent; "
        "pickle.loads(pickle.dumps(end_with_parent)); "
        "print(sorted({'numpy', 'cv2', 'mujoco', 'pydantic'} & set(sys.modules)))"
    )
    assert loaded(code) == "[]\n"


def test_the_simulator_starts_no_process_as_it_is_loaded() -> None:
    """MuJoCo's window library would, and one that is ended halfway prints a traceback."""
    pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
    code = (
        "import sys; begun = []; "
        "sys.addaudithook(lambda name, _: name == 'subprocess.Popen' and begun.append(name)); "
        "import perchctl.sim.world; print(begun, 'glfw' in sys.modules)"
    )
    assert loaded(code) == "[] False\n"
