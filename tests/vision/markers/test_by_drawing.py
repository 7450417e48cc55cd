"""What a marker that is measured by its drawing claims."""

from __future__ import annotations

import numpy as np

from perchctl.vision.markers.blurred import aligned
from tests.helpers.markers import SETUP, corners
from tests.helpers.target_picture import CAMERA, pose_of, render


def test_a_drawing_whose_white_is_clipped_is_measured_less_surely() -> None:
    """No light makes it then: its corners were off by three times what was claimed of them."""
    rvec, tvec = pose_of(0.02, -0.01, 0.6, 0.4, 0.0, 0.0)
    image = render(rvec, tvec, blur_px=0.8)
    start = corners("small", (rvec, tvec))
    bright = np.clip(image * (1.45 * 255.0 / float(image.max())), 0, 255).astype(np.uint8)
    dim = np.clip(image * (200.0 / float(image.max())), 0, 255).astype(np.uint8)
    true, clipped = (
        aligned(seen, start, SETUP.patterns["small"], CAMERA, alone=False) for seen in (dim, bright)
    )
    assert true is not None
    assert clipped is not None
    assert true.sigma_px < 0.05
    assert clipped.sigma_px > 0.1
