"""The work behind `perchctl log export`: a log in a form that other programs open."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from perchctl.commands.log_file import log_file, opened
from perchctl.commands.output import print_record, say
from perchctl.errors import InvalidValue, UsageError
from perchctl.files import check_output, same_file, write_files
from perchctl.log import (
    check_parquet,
    csv_text,
    export_mcap,
    log_columns,
    parquet_bytes,
    path_beside,
    recording_path,
)

STDOUT = Path("-")
ENDINGS = {"csv": ".csv", "parquet": ".parquet", "mcap": ".mcap"}

_COUNTS = ("rows", "columns", "pictures")


def run(
    file: Path | None,
    forms: Sequence[str],
    output: Path | None,
    force: bool,
    profile: str | None,
    log_dir: Path | None,
    as_json: bool,
) -> int:
    """Write; returns the exit code. Errors: NotFound, InvalidValue, UsageError."""
    form = _form(forms, output)
    if output == STDOUT and (form != "csv" or as_json):
        beside_it = "--json" if form == "csv" else f"--{form}"
        raise UsageError(f"-o - is CSV on stdout, which {beside_it} does not go with: name a file")
    if form == "parquet":
        check_parquet()
    path = log_file(file, profile, log_dir)
    if output == STDOUT:
        with opened(path) as log:
            text = csv_text(log_columns(log))
        sys.stdout.write(text)
        return 0
    place = output or path_beside(path, ("_export" if form == "mcap" else "") + ENDINGS[form])
    check_output(place, (ENDINGS[form],), force, f"what --{form} writes")
    write = _write_mcap if form == "mcap" else _write_table
    done = write(path, place, force)
    if as_json:
        print_record({"log": str(path), "output": str(place), "format": form, **done})
        return 0
    counted = ", ".join(f"{done[key]} {key}" for key in _COUNTS if key in done)
    print(f"export:    {place} ({counted})")
    if "layout" in done:
        print(f"layout:    {done['layout']}, for Foxglove")
    return 0


def _form(asked: Sequence[str], output: Path | None) -> str:
    """What is asked for by name, or else by the output's ending. Errors: UsageError."""
    if len(asked) > 1:
        raise UsageError(f"--{asked[0]} and --{asked[1]} are two files: ask for one at a time")
    if asked:
        return asked[0]
    if output == STDOUT:
        return "csv"
    if output is not None:
        for form, ending in ENDINGS.items():
            if output.suffix.lower() == ending:
                return form
    raise UsageError(
        "say in which form: --csv, --parquet or --mcap, or by the name, as in -o flight.csv"
    )


def _write_table(path: Path, place: Path, _force: bool) -> dict[str, Any]:
    with opened(path) as log:
        columns = log_columns(log)
        if place.suffix.lower() == ENDINGS["csv"]:
            content = csv_text(columns).encode("utf-8", errors="backslashreplace")
        else:
            content = parquet_bytes(log, columns)
    write_files({place: content})
    return {"rows": len(columns[0].values), "columns": len(columns)}


def _write_mcap(path: Path, place: Path, force: bool) -> dict[str, Any]:
    own = recording_path(path)
    if same_file(place, own):
        raise InvalidValue(
            f"{own} is the flight's own recording, with its pictures: open that, or name another "
            f"file with -o"
        )
    with opened(path) as log:
        done = export_mcap(log, place, force)
    for note in done.notes:
        say(note)
    return {"layout": str(done.layout), "pictures": done.pictures, "notes": list(done.notes)}
