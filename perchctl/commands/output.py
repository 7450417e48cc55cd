"""The output of commands: messages go to stderr, results to stdout."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import termios
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from perchctl.errors import PerchError
from perchctl.wrapping import wrap_for

NO = ("n", "no", "q", "quit")
"""Answers that cancel a prompt that only waits for Enter."""


def say(sentence: str) -> None:
    """Print a message on stderr, because stdout is for results. Never raises an exception."""
    print_lines(f"perchctl: {sentence}")


def say_on_terminal(sentence: str) -> None:
    """Print what the command is about to do, because loading libraries then takes a second or more.
    Print only on a terminal: nobody is watching a pipe or a file."""
    with contextlib.suppress(OSError, ValueError):
        if sys.stderr.isatty():
            say(sentence)


def print_lines(text: str, stdout: bool = False) -> bool:
    """Print lines on stderr or stdout, wrapped between words on a terminal; a closed terminal or
    broken pipe is not an error. Return False if a result on stdout is lost, for example because a
    disk is full."""
    stream = sys.stdout if stdout else sys.stderr
    try:
        print(wrap_for(stream, text), file=stream, flush=True)
    except (OSError, ValueError) as error:
        discard_output(stream)
        if stdout and isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
            say(f"the result cannot be written: {error.strerror}; free some space")
            return False
    return True


def discard_output(stream: TextIO) -> None:
    """Discard the stream's buffered output, so that flushing it at exit does not fail."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def stdin_number() -> int:
    """The file descriptor of stdin; -1, which is not a valid one, if there is no stdin."""
    try:
        return sys.stdin.fileno()
    except (OSError, ValueError, AttributeError):
        return -1


def ask(question: str) -> str:
    """Ask a question on stderr, with line editing on a terminal, and return the typed line. Raises
    EOFError at the end of the input."""
    question = wrap_for(sys.stderr, question.rstrip())
    if sys.stdin.isatty() and sys.stdout.isatty():
        with contextlib.suppress(ImportError):
            import readline  # noqa: F401  importing it enables line editing in input()
        *above, last = question.split("\n")
        if above:
            print("\n".join(above), file=sys.stderr, flush=True)
        return input(f"{last} ")  # readline redraws its own prompt during editing
    print(f"{question} ", end="", file=sys.stderr, flush=True)
    return input()


def ask_to_confirm(question: str) -> bool:
    """Ask a yes-or-no question on the terminal; return True if the answer is yes. Input typed
    before the question is discarded."""
    with contextlib.suppress(OSError, ValueError, termios.error):
        termios.tcflush(stdin_number(), termios.TCIFLUSH)
    try:
        return ask(f"{question} [y/N]").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def add_problem(record: Mapping[str, Any], problem: PerchError | None) -> dict[str, Any]:
    """Return a command's JSON object, with `problem` as its error and exit code if there is one."""
    if problem is None:
        return dict(record)
    return {**record, "error": str(problem), "exit_code": problem.exit_code}


def print_result(result: Mapping[str, Any] | Sequence[Any] | str | Path) -> None:
    """Print a command's result on stdout: text or a path as it is, anything else as JSON."""
    print(result if isinstance(result, str | Path) else json.dumps(result), flush=True)
