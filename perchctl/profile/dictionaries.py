"""ArUco dictionaries by name, and the ids they hold."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import cv2


@cache
def dictionary_names() -> tuple[str, ...]:
    """Return all predefined dictionaries of the installed OpenCV, sorted."""
    return tuple(sorted(n for n in dir(cv2.aruco) if re.fullmatch(r"DICT_[A-Z0-9_]+", n)))


@cache
def aruco_dictionary(name: str) -> Any:
    """Return the cv2.aruco dictionary of that name. Raises ValueError with the choices."""
    if name not in dictionary_names():
        raise ValueError(
            f"dictionary {name!r} is unknown; allowed are {', '.join(dictionary_names())}"
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def dictionary_size(name: str) -> int:
    """Return how many ids the dictionary holds (0 .. count - 1)."""
    return int(aruco_dictionary(name).bytesList.shape[0])


def is_one_pattern(name: str, marker_id: int, other: str, other_id: int) -> bool:
    """Return whether both are the same black and white cells, at any turn: ``DICT_4X4_50`` holds
    the first ids of ``DICT_4X4_1000``."""
    one, two = aruco_dictionary(name), aruco_dictionary(other)
    if one.markerSize != two.markerSize:
        return False
    turns = two.bytesList[other_id].reshape(4, -1)  # a row for each quarter turn
    cells = one.bytesList[marker_id].reshape(4, -1)[0]
    return any(bool((cells == turn).all()) for turn in turns)


def check_marker_id(name: str, marker_id: int) -> None:
    """Raises ValueError when the id is outside its dictionary, with what would hold it."""
    count = dictionary_size(name)
    if marker_id < count:
        return
    hint = ""
    match = re.fullmatch(r"(DICT_\d+X\d+)_\d+", name)
    if match:
        family = [n for n in dictionary_names() if n.startswith(match.group(1) + "_")]
        larger = sorted((dictionary_size(n), n) for n in family if dictionary_size(n) > marker_id)
        if larger:
            hint = f"; {larger[0][1]} holds it"
    raise ValueError(f"id {marker_id} is outside {name}, which holds 0..{count - 1}{hint}")
