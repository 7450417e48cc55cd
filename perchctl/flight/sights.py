"""The target as positioning system, turn by turn.

Standing, pressed or hanging, the place is known better than by any picture, and is sent in its
stead; only while the accelerometer says that something carries the vehicle. What falls while it
is told that it hangs would look as if it hung, so the first sample that says otherwise ends that.
"""

from __future__ import annotations

from perchctl.flight.history import History, attitude_at, attitude_of
from perchctl.positioning import FeedStatus, SightFeed
from perchctl.profile import Profile
from perchctl.vehicle import SendPosition
from perchctl.vision import MeasuredMarkers, Pipeline, TargetEstimate, surest_pose

CARRIED_FOR_S = 0.1
CARRIED_G, CARRIED_MEAN_G = 0.25, 0.06
"""An accelerometer at rest reads one g; with turning motors it scatters by 0.04, the mean of ten by
0.013."""
SINKING_MPS = -0.15
"""No such speed comes of a bias while the place is sent."""
FROZEN_S = 0.06
"""An attitude that reads the very same for so long is not the one at the picture's exposure, and
0.1 rad of it places a vehicle 1.2 m under the target 12 cm aside."""


class Sights:
    """Of one flight. `status` goes to the planner as that of a motion capture does."""

    def __init__(self, send: SendPosition, pipeline: Pipeline, profile: Profile) -> None:
        self.feed = SightFeed(send, profile, pipeline.pose)
        self._touches = False

    def status(self, now_s: float) -> FeedStatus:
        return self.feed.status(now_s)

    def begin(self, history: History, now_s: float, *, touches: bool) -> None:
        """A turn, before its picture. `touches`: contact was proven, and nothing has shown since
        that it ended."""
        newest = history.newest
        self._touches = touches
        if newest is None or not is_carried(history, now_s):
            return
        touching_m = self.feed.touching(newest.yaw_rad)
        if touching_m is None:
            self.feed.stand(now_s)
        elif touches:
            self.feed.known(touching_m, now_s)

    def see(self, measured: MeasuredMarkers, history: History, now_s: float) -> None:
        """A picture. What is pressed or hangs needs none, and the last ones were of before."""
        pose = surest_pose(measured)
        if pose is None or self._touches or history.imu.attitude_age_s > FROZEN_S:
            return
        then, now = attitude_at(history, pose.t_s), attitude_at(history, now_s)
        if then is not None and now is not None:
            self.feed.see(pose, then, now, now_s, at_rest=is_carried(history, now_s))

    def steered(self, target: TargetEstimate | None, history: History) -> TargetEstimate | None:
        """The target where it stands; as it is seen until its place is known."""
        newest = history.newest
        if target is None or newest is None:
            return target
        return self.feed.steered(target, attitude_of(newest))


def is_carried(history: History, now_s: float) -> bool:
    """Whether something has carried the vehicle for the last moments, by fresh samples."""
    newest = history.newest
    if newest is None or now_s - newest.t_s + newest.behind_s > CARRIED_FOR_S:
        return False
    lately = [s for s in history.samples if newest.t_s - s.t_s <= CARRIED_FOR_S]
    mean_g = sum(s.acc_z_g for s in lately) / len(lately)
    return abs(mean_g - 1.0) <= CARRIED_MEAN_G and all(
        abs(s.acc_z_g - 1.0) <= CARRIED_G and s.velocity_mps[2] > SINKING_MPS for s in lately
    )
