"""What a process of perchctl's own loads before it can end with its parent, and its connection."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

import pytest

from perchctl import children
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


def test_a_foreign_connection_cannot_take_the_childs_place() -> None:
    """A connection without the token is closed before anything is unpickled."""
    with children.listen() as listener:
        foreign = socket.create_connection(listener.getsockname())
        foreign.sendall(b"0" * 64)
        connection = socket.create_connection(listener.getsockname())
        connection.sendall(b"f" * 64)
        friend = children.Channel(connection)
        channel = children.accept(listener, "f" * 64, 5.0, lambda: True)
        assert channel is not None
        friend.send({"a": 1})
        assert channel.receive(5.0) == {"a": 1}
        friend.close()
        with pytest.raises(EOFError):
            channel.receive(5.0)
        channel.close()
        foreign.close()
