"""Pictures changed as other cameras would: half of them, by the generator, within bounds."""

import numpy as np
import pytest

from vn_nav.learning import augmentation
from vn_nav.learning.augmentation import SHARE, augment


def pictures(count=400, size=32):
    random = np.random.default_rng(5)
    ramp = np.linspace(40, 200, size, dtype=np.float32)
    smooth = ramp[None, None, :, None] + 0.2 * ramp[None, None, None, :]
    tint = random.uniform(0.6, 1.0, (count, 3, 1, 1))
    return np.clip(smooth * tint, 0, 255).astype(np.uint8)


def test_a_share_is_changed_and_the_generator_decides():
    before = pictures()
    images, again, other = before.copy(), before.copy(), before.copy()
    augment(images, np.random.default_rng(1))
    augment(again, np.random.default_rng(1))
    augment(other, np.random.default_rng(2))
    changed = (images != before).any((1, 2, 3))
    assert abs(changed.mean() - SHARE) < 0.08
    assert np.array_equal(images, again) and not np.array_equal(images, other)
    assert images.shape == before.shape and images.dtype == np.uint8


def test_geometry_stays(monkeypatch):
    """Neither moved nor mirrored: what is brighter below stays so."""
    monkeypatch.setattr(augmentation, 'COVERED_SHARE', 0.0)
    before = pictures()
    images = before.copy()
    augment(images, np.random.default_rng(1))
    rows = images.astype(float).mean((1, 3))  # [V,S]
    slope = np.arange(rows.shape[1]) - (rows.shape[1] - 1) / 2
    trend = (rows - rows.mean(1, keepdims=True)) @ slope
    assert (trend > 0).all()


@pytest.mark.parametrize('name', ['GREY_SHARE', 'BLUR_SHARE', 'COVERED_SHARE', 'SHADED_SHARE'])
def test_each_change_does_something(name, monkeypatch):
    found = []
    for share in (0.0, 1.0):
        for other in ('GREY_SHARE', 'BLUR_SHARE', 'COVERED_SHARE', 'SHADED_SHARE'):
            monkeypatch.setattr(augmentation, other, share if other == name else 0.0)
        monkeypatch.setattr(augmentation, 'NOISE', 0.0)
        images = pictures(60)
        images[:, :, ::4] //= 2  # something to blur
        augment(images, np.random.default_rng(4))
        values = images.astype(float)
        found.append({
            'GREY_SHARE': np.abs(values - values.mean(1, keepdims=True)).mean(),
            'BLUR_SHARE': np.abs(np.diff(values, axis=2)).mean(),
            'COVERED_SHARE': -(np.abs(np.diff(values, axis=3)) == 0).mean(),
            'SHADED_SHARE': values[:, :, (0, -1)][..., (0, -1)].mean()}[name])
    assert found[1] < found[0]
