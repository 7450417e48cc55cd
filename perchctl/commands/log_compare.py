"""The work behind `perchctl log compare`."""

from __future__ import annotations

from pathlib import Path

from perchctl.commands.log_file import opened
from perchctl.commands.log_plot import DRAWN_IN, FORMATS
from perchctl.commands.output import print_record
from perchctl.files import check_output
from perchctl.log import compare_flights, comparison_record, comparison_text


def run(one_path: Path, other_path: Path, picture: Path | None, force: bool, as_json: bool) -> int:
    """Print the differences, draw both where asked to; returns the exit code.

    Errors: NotFound, InvalidValue.
    """
    if picture is not None:
        check_output(picture, FORMATS, force, DRAWN_IN)
    with opened(one_path) as one, opened(other_path) as other:
        found = compare_flights(one, other)
        record, text = comparison_record(found), comparison_text(found)
    if picture is not None:
        from perchctl.log import plot_comparison

        plot_comparison(one, other, picture)
    if as_json:
        print_record(record | {"plot": None if picture is None else str(picture)})
        return 0
    print(text)
    if picture is not None:
        print(f"\nplot:      {picture}")
    return 0
