"""The work behind `perchctl log compare`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.commands.log_file import opened
from perchctl.commands.log_plot import DRAWN_IN, FORMATS
from perchctl.commands.output import print_record
from perchctl.files import check_output
from perchctl.log import compare_flights, comparison_record, comparison_text


@dataclass(frozen=True)
class CompareRequest:
    """The command line as it was given; None is not given."""

    one: Path
    other: Path
    output: Path | None = None
    force: bool = False
    as_json: bool = False


def run(request: CompareRequest) -> int:
    """Print the differences, draw both where asked to; returns the exit code.

    Errors: NotFound, InvalidValue.
    """
    picture = request.output
    if picture is not None:
        check_output(picture, FORMATS, request.force, DRAWN_IN)
    with opened(request.one) as one, opened(request.other) as other:
        found = compare_flights(one, other)
        record, text = comparison_record(found), comparison_text(found)
    if picture is not None:
        from perchctl.log import plot_comparison

        plot_comparison(one, other, picture)
    if request.as_json:
        print_record(record | {"plot": None if picture is None else str(picture)})
        return 0
    print(text)
    if picture is not None:
        print(f"\nplot:      {picture}")
    return 0
