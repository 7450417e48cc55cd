"""Products taken block by block are the products."""

from __future__ import annotations

import numpy as np
import pytest

from perchctl.vision.markers.photometric_fit import gram, mixed, onto


@pytest.mark.parametrize("count", [18 * 18, 256, 512, 44 * 44])
def test_products(count: int) -> None:
    rng = np.random.default_rng(count)
    rows, values, coefficients = rng.normal(size=(17, count)), rng.normal(size=count), np.ones(17)
    assert np.allclose(gram(rows), rows @ rows.T, rtol=1e-12, atol=1e-9)
    assert np.allclose(onto(rows, values), rows @ values, rtol=1e-12, atol=1e-9)
    assert np.allclose(mixed(rows, coefficients), rows.sum(axis=0), rtol=1e-12, atol=1e-9)
