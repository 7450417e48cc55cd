"""Pictures of a camera at rest: made once, wherever it is in a row, and as true as others."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from perchctl.geometry import Array, make_T, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim import Renderer, Scenario
from perchctl.sim.still import Stills, rounded
from perchctl.vision import CameraModel

CAMERA = CameraModel(
    (320, 240), np.array([[200.0, 0, 159.5], [0, 200.0, 119.5], [0, 0, 1.0]]), np.zeros(5)
)
SCENE = Scenario(ceiling_z_m=2.0, camera_noise_sigma=3.0)


def exposed(below_m: float, stir: float, *, moving: bool = False) -> list[Array]:
    """The poses of an exposure; `stir` in m and rad."""
    far = 0.02 if moving else 0.0
    return [
        make_T(rotation_from_rpy(0.02 + stir, 0.1, 0.5 + k * far), (stir, 0.01, 2.0 - below_m))
        for k in range(3)
    ]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one with each picture that is made."""
    count: list[int] = []
    before: Callable[..., Any] = Renderer._projected

    def watched(*args: Any) -> Any:
        count.append(1)
        return before(*args)

    monkeypatch.setattr(Renderer, "_projected", watched)
    return count


def test_a_camera_that_only_stirs_has_one_picture_and_new_noise(made: list[int]) -> None:
    renderer = Renderer(SCENE, CAMERA, TargetConfig())
    frames = [renderer.render(exposed(1.0, 1e-8 * k), frame_index=k) for k in range(5)]
    assert len(made) == 1
    assert all(np.mean(a != b) > 0.5 for a, b in pairwise(frames))


def test_what_moves_is_made_anew(made: list[int]) -> None:
    renderer = Renderer(SCENE, CAMERA, TargetConfig())
    for k in range(3):
        renderer.render(exposed(1.0, 1e-4 * k))
        renderer.render(exposed(1.0, 0.0, moving=True))
    renderer.move_target((0.1, 0.0))
    renderer.render(exposed(1.0, 2e-4))
    assert len(made) == 7


def test_no_picture_hangs_on_those_before() -> None:
    """Which of them are looked at is the flight's affair, and no other bytes may follow from it."""
    stirring = [exposed(0.6, 3e-6 * k) for k in range(8)]
    all_seen = Renderer(SCENE, CAMERA, TargetConfig())
    frames = [all_seen.render(poses, frame_index=7) for poses in stirring]
    for poses, frame in zip(stirring, frames, strict=True):
        alone = Renderer(SCENE, CAMERA, TargetConfig())
        assert np.array_equal(alone.render(poses, frame_index=7), frame)


@pytest.mark.parametrize("below_m", [0.02, 0.3, 2.0])
def test_a_rounded_pose_shows_each_place_where_it_is(below_m: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        T = make_T(
            rotation_from_rpy(*rng.uniform(-0.3, 0.3, 3)),
            (*rng.uniform(-0.5, 0.5, 2) * below_m, -below_m),
        )
        points = np.array([[*rng.uniform(-0.5, 0.5, 2) * below_m, 0.0] for _ in range(9)])
        seen = [(points - t[:3, 3]) @ t[:3, :3] for t in (T, rounded(T))]
        one, other = (400.0 * cam[:, :2] / cam[:, 2:] for cam in seen)
        within = (np.abs(one) < (400.0, 300.0)).all(axis=1)
        assert np.abs(one - other)[within].max(initial=0.0) < 0.01


def test_without_noise_a_kept_picture_is_nobody_s_to_spoil() -> None:
    renderer = Renderer(replace(SCENE, camera_noise_sigma=0.0), CAMERA, TargetConfig())
    first = renderer.render(exposed(1.0, 0.0))
    kept = first.copy()
    first[:] = 0
    assert np.array_equal(renderer.render(exposed(1.0, 0.0)), kept)


def test_the_lens_s_blur_belongs_to_a_picture() -> None:
    stills, poses = Stills(), rounded(exposed(1.0, 0.0)[0])
    greys = [stills.picture(poses, s, partial(np.full, (2, 2), int(s), np.uint8)) for s in (1, 2)]
    assert [int(grey[0, 0]) for grey in greys] == [1, 2]
