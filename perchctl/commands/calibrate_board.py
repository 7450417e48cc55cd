"""The board that `perchctl calibrate` looks for: its notation, and what its print measures."""

from __future__ import annotations

from perchctl.errors import UsageError
from perchctl.target import NOTABLE_SCALE_ERROR, Board, mm_text, parse_board, parse_length


def board_of(notation: str, width: str | None, height: str | None) -> tuple[Board, list[str]]:
    """The board, and what its measured sides (of the black area, mm) say of the print.

    Raises NotFound, InvalidValue, UsageError.
    """
    board = parse_board(notation)
    if width is None and height is None:
        return board, []
    if width is None or height is None:
        raise UsageError(
            "--measured-width and --measured-height go together: a lens is told from the "
            "print's proportions, which one of them leaves open"
        )
    sides_m = (
        parse_length(width, "--measured-width", bare_unit="mm"),
        parse_length(height, "--measured-height", bare_unit="mm"),
    )
    board = board.measured(*sides_m)
    notes = []
    for name, meant_m, is_m, scale in zip(
        ("width", "height"), board.size_m, sides_m, board.scale, strict=True
    ):
        off = f"{100 * (scale - 1):+.2f} % against {mm_text(meant_m)} mm"
        notes.append(f"{name}: {mm_text(is_m)} mm, {off}")
        if abs(scale - 1) > NOTABLE_SCALE_ERROR:
            notes.append(f"{name}: more than 1 % off: was the page scaled when it was printed?")
    return board, notes
