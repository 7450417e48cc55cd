"""The corridor of one vehicle, and exact distances between corridors.

A vehicle's flight has three parts: a column above its take-off position, the path to the target,
and a column under the target. Seen from above, they form one shape: all points within a radius of
the straight line from home to target:

           .-----------------------------.
          /                               \\
         |   home x ------------- x target |     radius_m around the line
          \\                               /
           '-----------------------------'

The corridors of two vehicles must not overlap in this view, regardless of height, because the
downwash of a hovering vehicle pushes down another one even 2 m below. All distances in this module
are therefore horizontal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Point = tuple[float, float]
"""x and y, m."""


@dataclass(frozen=True, kw_only=True)
class Corridor:
    """The space that one flight may use.

    Attributes:
        home_m: the take-off position.
        target_m: the position below the target.
        radius_m: largest horizontal distance from the line between them. Larger: fewer vehicles fit
            into a room. Smaller: a draught may carry the vehicle out of the corridor.
        way_top_m: height above the ground up to which the whole corridor may be used.
        target_top_m: height up to which the column under the target may be used.
    """

    home_m: Point
    target_m: Point
    radius_m: float
    way_top_m: float
    target_top_m: float

    def contains(self, x_m: float, y_m: float, z_m: float) -> bool:
        """True for a point in the corridor or on its surface; `z_m` is the height above the ground.
        False if a coordinate is NaN. The corridor has no lower limit, because a landing aims below
        the floor."""
        place = x_m, y_m
        if not point_distance_m(place, self.home_m, self.target_m) <= self.radius_m:
            return False
        under_target = math.dist(place, self.target_m) <= self.radius_m
        return z_m <= (self.target_top_m if under_target else self.way_top_m)

    def distance_m(self, other: Corridor) -> float:
        """Horizontal distance between the edges of two corridors; negative if they overlap."""
        axes_m = segment_distance_m(self.home_m, self.target_m, other.home_m, other.target_m)
        return axes_m - (self.radius_m + other.radius_m)

    def distance_to_m(self, place_m: Point) -> float:
        """Horizontal distance of a point from the edge of the corridor; negative inside."""
        return point_distance_m(place_m, self.home_m, self.target_m) - self.radius_m


def point_distance_m(point: Point, start: Point, end: Point) -> float:
    """Distance of a point from the segment between `start` and `end`, which may be one point."""
    (px, py), (ax, ay), (bx, by) = point, start, end
    dx, dy = bx - ax, by - ay
    length2 = dx * dx + dy * dy
    share = ((px - ax) * dx + (py - ay) * dy) / length2 if length2 > 0.0 else 0.0
    # The end points are handled separately, because a + (b - a) is not always b.
    inside = math.hypot(px - ax - share * dx, py - ay - share * dy) if 0.0 < share < 1.0 else None
    ends = min(math.dist(point, start), math.dist(point, end))
    return ends if inside is None else min(inside, ends)


def segment_distance_m(a: Point, b: Point, c: Point, d: Point) -> float:
    """Distance between the segments a to b and c to d; 0 if they cross."""
    if _are_apart(a, b, c, d) and _are_apart(c, d, a, b):
        return 0.0
    return min(
        point_distance_m(a, c, d),
        point_distance_m(b, c, d),
        point_distance_m(c, a, b),
        point_distance_m(d, a, b),
    )


def _are_apart(a: Point, b: Point, c: Point, d: Point) -> bool:
    """True if c and d are on different sides of the line through a and b."""
    return _side(a, b, c) * _side(a, b, d) < 0.0


def _side(a: Point, b: Point, p: Point) -> float:
    return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])
