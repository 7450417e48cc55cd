"""The tags of an aprilgrid in a picture.

The black squares in the gaps touch the tags' corners, so that in a soft or tilted picture tags
hang together with their squares and have no outline of their own. OpenCV's detector is set so
that it finds some all the same; the others are looked for where their neighbours say that they
are, and taken when their very pattern is there.
"""

from __future__ import annotations

import cv2
import numpy as np

from perchctl.camera import Grey
from perchctl.geometry import Array
from perchctl.profile import aruco_dictionary
from perchctl.target import TAG_BORDER_CELLS, TAG_DICTIONARY, Board, tag_cells

_SEARCH_PX = 1600
_MOST_ENLARGED = 2.0
"""Where tags are small, twice the size finds half as many again."""
_DARKER = (15.0, 7.0)
"""By so many grey levels a pixel is darker than those around it to count as black. Many cut the
squares off at the corners, where it is grey; few are for a picture of little contrast."""
_OFF_PLANE = 0.3
"""Of a tag's side: so far a lens may bend the board's plane, or the tag is another's."""
_NEAREST, _FEWEST = 4, 2
"""Tags by which the place of another one is told."""
_BESIDE = 2.3  # so far away, in distances of two tags, they are at most
_CELL_PX = 4  # of a tag brought upright
_MATCHING_INSIDE, _MATCHING_BORDER = 0.8, 0.85  # of its cells; the rest is blur
_LEAST_CONTRAST = 12.0  # grey levels between its black and its white cells


def find_tags(image: Grey, board: Board) -> dict[int, Array] | str:
    """The board's tags that are wholly in the picture: number -> corners (4, 2) px, in the
    order of `Board.tag_corners`; or why there are none."""
    places = board.corners_m()[:, :2]
    on_board = {t: places[list(board.tag_corners(t))] for t in range(board.columns * board.rows)}
    detected = detect_tags(image, len(on_board))
    seen = _on_one_plane(detected, on_board)
    if not seen:
        return "no board found"
    if 2 * len(seen) < len(detected):
        return f"{len(detected)} tags, but not in the places that the board has them"
    found = {tag: _sharpened(image, corners, board) for tag, corners in seen.items()}
    pitch_m = float(np.ptp(np.concatenate([on_board[0], on_board[1]])[[0, 4], 0]))
    while added := _completed(image, found, on_board, pitch_m):
        found |= {tag: _sharpened(image, corners, board) for tag, corners in added.items()}
    return found


def detect_tags(image: Grey, count: int) -> dict[int, Array]:
    """The tags below `count` that OpenCV finds, as `find_tags`."""
    scale = min(_MOST_ENLARGED, max(1.0, _SEARCH_PX / max(image.shape)))
    large = image
    if scale > 1.0:
        resized = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        large = np.asarray(resized, np.uint8)
    found: dict[int, Array] = {}
    for darker in _DARKER:
        corners, ids, _ = _detector(darker).detectMarkers(large)
        for number, quad in zip([] if ids is None else ids.ravel(), corners, strict=True):
            if number < count:
                four: Array = np.asarray(quad, dtype=np.float64).reshape(4, 2)
                found.setdefault(int(number), (four + 0.5) / scale - 0.5)
        if 2 * len(found) >= count:
            break
    return found


def _detector(darker: float) -> cv2.aruco.ArucoDetector:
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(TAG_DICTIONARY))
    finding = detector.getDetectorParameters()
    finding.markerBorderBits = TAG_BORDER_CELLS
    finding.minMarkerPerimeterRate = 0.01
    finding.minDistanceToBorder = 0
    finding.adaptiveThreshConstant = darker
    finding.perspectiveRemovePixelPerCell = 8
    finding.perspectiveRemoveIgnoredMarginPerCell = 0.3
    # A code of 36 bits is far from every other: five wrong ones leave it certain.
    finding.errorCorrectionRate = 1.0
    finding.maxErroneousBitsInBorderRate = 0.5
    detector.setDetectorParameters(finding)
    return detector


def _on_one_plane(seen: dict[int, Array], on_board: dict[int, Array]) -> dict[int, Array]:
    """Without those that lie where the others say that they are not."""
    if len(seen) < _FEWEST:
        return seen
    here, there = (np.concatenate([side[tag] for tag in seen]) for side in (seen, on_board))
    sides = [np.linalg.norm(corners[0] - corners[1]) for corners in seen.values()]
    limit_px = _OFF_PLANE * float(np.median(sides))
    _, inside = cv2.findHomography(there, here, cv2.RANSAC, limit_px)
    if inside is None:
        return {}
    good = inside.reshape(-1, 4) > 0
    return {tag: seen[tag] for tag, four in zip(seen, good, strict=True) if four.all()}


def _sharpened(image: Grey, corners: Array, board: Board) -> Array:
    """Corners to a fraction of a pixel, which the prediction of others needs."""
    assert board.marker_m is not None
    side_px = min(float(np.linalg.norm(corners[k] - corners[k - 1])) for k in range(4))
    half = max(2, round(0.4 * side_px * board.square_m / board.marker_m))
    start = np.clip(corners, 0, np.array(image.shape[::-1]) - 1.0).astype(np.float32)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
    moved = cv2.cornerSubPix(image, start.reshape(-1, 1, 2), (half, half), (-1, -1), criteria)
    moved = moved.reshape(-1, 2)
    near = np.linalg.norm(moved - corners, axis=1) <= half
    return np.asarray(np.where(near[:, None], moved, corners), dtype=np.float64)


def _completed(
    image: Grey, found: dict[int, Array], on_board: dict[int, Array], pitch_m: float
) -> dict[int, Array]:
    """Tags beside those found that are where these say."""
    added = {}
    middles = {tag: corners.mean(axis=0) for tag, corners in on_board.items()}
    for tag in on_board.keys() - found.keys():
        away = {t: float(np.linalg.norm(middles[t] - middles[tag])) for t in found}
        nearest = sorted(away, key=lambda t: away[t])[:_NEAREST]
        if len(nearest) < _FEWEST or away[nearest[_FEWEST - 1]] > _BESIDE * pitch_m:
            continue
        H, _ = cv2.findHomography(
            np.concatenate([on_board[t] for t in nearest]),
            np.concatenate([found[t] for t in nearest]),
        )
        if H is None:
            continue
        mapped = np.column_stack([on_board[tag], np.ones(4)]) @ H.T
        corners: Array = np.asarray(mapped[:, :2] / mapped[:, 2:], dtype=np.float64)
        if _shows(image, tag, corners):
            added[tag] = corners
    return added


def _shows(image: Grey, tag: int, corners: Array) -> bool:
    """Whether that tag's pattern lies between these corners (in OpenCV's order)."""
    h, w = image.shape
    if (corners < 0).any() or (corners > (w - 1, h - 1)).any():
        return False
    black = tag_cells(tag)[::-1, ::-1]  # as OpenCV has its corners
    n = len(black)
    side = n * _CELL_PX
    flat = np.array([[0, 0], [side, 0], [side, side], [0, side]], dtype=np.float32) - 0.5
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), flat.astype(np.float32))
    upright = cv2.warpPerspective(image, H, (side, side))
    grey = np.asarray(cv2.resize(upright, (n, n), interpolation=cv2.INTER_AREA), np.float64)
    dark, light = float(np.median(grey[black])), float(np.median(grey[~black]))
    if light - dark < _LEAST_CONTRAST:
        return False
    right = (grey < (dark + light) / 2) == black
    border = np.ones_like(black)
    border[TAG_BORDER_CELLS:-TAG_BORDER_CELLS, TAG_BORDER_CELLS:-TAG_BORDER_CELLS] = False
    inside = right[~border].mean() >= _MATCHING_INSIDE
    return bool(inside and right[border].mean() >= _MATCHING_BORDER)
