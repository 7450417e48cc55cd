"""What a command prints: sentences for people on stderr, the result on stdout."""

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


def say(sentence: str) -> None:
    """Print one sentence on stderr, as stdout is for the result. Never raises."""
    print_lines(f"perchctl: {sentence}")


def print_lines(text: str, stdout: bool = False) -> None:
    """Print lines on stderr or stdout; a closed terminal or pipe is no reason to fail."""
    stream = sys.stdout if stdout else sys.stderr
    try:
        print(text, file=stream, flush=True)
    except (OSError, ValueError) as error:
        if stdout and isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
            say(f"the result cannot be written: {error.strerror}; free some space")
        drop_stream(stream)


def drop_stream(stream: TextIO) -> None:
    """Discard what the stream still holds, so that it does not fail again at the program's end."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def ask(question: str) -> str:
    """Return the line that is typed; the question goes to stderr. Raises EOFError at its end."""
    print(f"{question.rstrip()} ", end="", file=sys.stderr, flush=True)
    return input()


def ask_to_confirm(question: str) -> bool:
    """Return True if somebody at the terminal says yes now: what was typed before the question
    appeared is no answer to it."""
    with contextlib.suppress(OSError, ValueError, AttributeError, termios.error):
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
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
    """Print a command's result on stdout: a text or a path as it is, all else as JSON."""
    print(result if isinstance(result, str | Path) else json.dumps(result), flush=True)
