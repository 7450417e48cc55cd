"""Handle Ctrl-C while libraries are loading: exit with one sentence and an exit code, without a
traceback.

A KeyboardInterrupt would occur in the middle of a library's import, which prints it as ignored or
turns it into another error. Nothing is open yet, so the process simply exits. This module imports
as little as possible, because Python's own Ctrl-C handling applies until it is loaded.
"""

from __future__ import annotations

# The part of `signal` that is built into the interpreter; the other part only adds enumerations.
import _signal as signal  # type: ignore[import-not-found]
import os
import sys

EXIT_CODE = 130
SENTENCE = "Ctrl-C"
NO_WINDOWS = (
    "Windows is not supported: install perchctl in WSL2 (wsl --install), and attach the radio and "
    "the camera to it with usbipd-win"
)
"""perchctl needs POSIX terminals, signals and locks, and Linux for cameras."""


def is_command_line() -> bool:
    """True if this process is perchctl's command line: not a program that imports it, nor a
    child process, which has the same arguments."""
    script = "" if "multiprocessing" in sys.modules else os.path.basename(sys.argv[0])
    if script == "-m":
        script = sys.orig_argv[-len(sys.argv)].removeprefix("-m")  # the module
    return script == "perchctl"


def exit_at_ctrl_c() -> None:
    """Exit on Ctrl-C from now on, unless Ctrl-C is ignored or has another handler already."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def restore_ctrl_c() -> None:
    """Make Ctrl-C raise a KeyboardInterrupt again from now on."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def refuse_windows() -> int:
    """Print that Windows is not supported; return the exit code."""
    sys.stderr.write(f"perchctl: {NO_WINDOWS}\n")
    if "--json" in sys.argv[1:]:
        sys.stdout.write(f"{failure_record(NO_WINDOWS, 1)}\n")
    return 1


def failure_record(sentence: str, code: int) -> str:
    """The JSON text that `--json` prints for a failure."""
    import json

    return json.dumps({"error": sentence, "exit_code": code})


def _leave(_signal: int, _frame: object) -> None:
    try:
        os.write(2, f"perchctl: {SENTENCE}\n".encode())
        if "--json" in sys.argv[1:]:
            os.write(1, f"{failure_record(SENTENCE, EXIT_CODE)}\n".encode())
    finally:
        os._exit(EXIT_CODE)
