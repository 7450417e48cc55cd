"""Products taken block by block are the products."""

from __future__ import annotations

import numpy as np
import pytest

from perchctl.vision.markers.products import gram


@pytest.mark.parametrize("rows", [18 * 18, 256, 512, 44 * 44])
def test_gram(rows: int) -> None:
    rng = np.random.default_rng(rows)
    A, B = rng.normal(size=(rows, 17)), rng.normal(size=(rows, 3))
    assert np.allclose(gram(A, B), A.T @ B, rtol=1e-12, atol=1e-9)
    assert np.allclose(gram(A, A), A.T @ A, rtol=1e-12, atol=1e-9)
