"""Targets of pictures: pixel change, averages of maps, colours of classes."""

import colorsys
import hashlib
import math

import pytest
import torch
from replay_stream import draws

from vn_nav.errors import UserError
from vn_nav.learning.pixel_change import average_pool_target, label_colours, pixel_change


@pytest.mark.parametrize('grey', [True, False])
def test_pixel_change_equals_a_naive_loop(grey):
    images = torch.randint(0, 256, (3, 2, 3, 11, 11), generator=draws(), dtype=torch.uint8)
    change = pixel_change(images, cell=2, cells=4, grey=grey)  # a crop of 8: rows 1 to 8
    assert change.shape == (2, 2, 4, 4) and change.dtype == torch.float32
    for t in range(2):
        for b in range(2):
            for y in range(4):
                for x in range(4):
                    total = 0.0
                    for i in range(1 + 2 * y, 3 + 2 * y):
                        for j in range(1 + 2 * x, 3 + 2 * x):
                            now, then = (images[t + k, b, :, i, j].tolist() for k in (1, 0))
                            difference = [p - q for p, q in zip(now, then, strict=True)]
                            if grey:
                                luma = (0.299, 0.587, 0.114)
                                total += abs(sum(w * d for w, d in
                                                 zip(luma, difference, strict=True)))
                            else:
                                total += sum(map(abs, difference)) / 3
                    assert float(change[t, b, y, x]) == pytest.approx(total / 4 / 255, abs=1e-6)


@pytest.mark.parametrize(('size', 'cells'), [(84, 20), (172, 42), (174, 42)])
def test_targets_have_the_sizes_of_the_thesis(size, cells):
    images = torch.zeros(2, 1, 3, size, size, dtype=torch.uint8)
    images[1] = 255
    change = pixel_change(images)
    assert change.shape == (1, 1, cells, cells) and bool((change > 0.999).all())
    depth = torch.arange(size, dtype=torch.float32).expand(1, 1, size, size)
    target = average_pool_target(depth, cells)
    margin = (size - 4 * cells) // 2
    assert target.shape == (1, 1, cells, cells)
    assert target[0, 0, 0].tolist() == [margin + 4 * k + 1.5 for k in range(cells)]
    with pytest.raises(UserError, match='fit into the picture'):
        average_pool_target(depth, cells + 2)


@pytest.mark.parametrize('count', [1, 2, 5, 12, 57])
def test_colours_lie_farther_apart_than_by_chance_or_on_a_wheel_of_hues(count):
    def gap(rgb):
        """Least distance in the HSB cone, from RGB by another road than the code's."""
        points = []
        for colour in rgb.tolist():
            hue, saturation, brightness = colorsys.rgb_to_hsv(*colour)
            angle = torch.tensor(hue * 2 * torch.pi)
            points.append([float(angle.cos()) * saturation * brightness,
                           float(angle.sin()) * saturation * brightness, brightness])
        return float(torch.pdist(torch.tensor(points)).min())
    colours = label_colours(count)
    assert colours.shape == (count, 3) and colours.dtype == torch.float32
    assert 0 <= float(colours.min()) and float(colours.max()) <= 1
    assert not colours[0].any() and torch.equal(colours, label_colours(count))
    if count > 1:
        black = torch.zeros(1, 3)
        hues = [colorsys.hsv_to_rgb(k / (count - 1), 1.0, 1.0) for k in range(count - 1)]
        others = [torch.rand(count - 1, 3, generator=draws(seed)) for seed in range(50)]
        for other in (torch.tensor(hues), *others):
            assert gap(colours) > gap(torch.cat([black, other])) - 1e-6
    with pytest.raises(UserError, match='1 to 65536 classes'):
        label_colours(65_537)


def test_the_colours_of_published_weights_are_as_they_were():
    """Of up to 64 classes, whatever more classes take."""
    digests = {5: 'c3dca6a10fc89f47', 57: 'adf4c80da5958f0c', 64: 'f528bdb54742cb04'}
    assert {count: hashlib.sha256(label_colours(count).numpy().tobytes()).hexdigest()[:16]
            for count in digests} == digests


@pytest.mark.parametrize('count', [65, 100, 190, 256, 257, 700, 1500])
def test_many_colours_are_as_far_apart_as_balls_can_be_packed(count):
    """The volume of the cone over their number says how far apart they can be inside it."""
    colours = label_colours(count)
    points = []
    for colour in colours.tolist():
        hue, saturation, brightness = colorsys.rgb_to_hsv(*colour)
        turn, chroma = 2 * math.pi * hue, saturation * brightness
        points.append([chroma * math.cos(turn), chroma * math.sin(turn), brightness])
    gap = float(torch.pdist(torch.tensor(points, dtype=torch.float64)).min())
    densest = (math.sqrt(2) * (math.pi / 3) / count) ** (1 / 3)
    assert gap > 0.95 * densest and not colours[0].any()
    assert 0 <= float(colours.min()) and float(colours.max()) <= 1
    assert torch.equal(colours, label_colours(count))
    # They are 8-bit pictures of this many colours, too.
    assert len({tuple(row) for row in (colours * 255).round().int().tolist()}) == count
