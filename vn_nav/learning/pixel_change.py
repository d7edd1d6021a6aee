"""Picture-shaped targets: pixel change, and what the image heads are to draw.

The heads' outputs are `cells` x `cells` maps. Each cell stands for a square of `cell` pixels of
the picture, on a centre crop of cells * cell pixels (84 px: 20 of 4 pixels; 174 px: 42 of 4).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from vn_nav.errors import UserError
from vn_nav.labels import CLASSES, MAX_CLASSES

GREY = (0.299, 0.587, 0.114)  # luma of ITU-R BT.601
# Candidate colours: hues, saturations and brightnesses of a grid in HSB.
HUES, LEVELS = 48, 8


def default_cells(size: int, cell: int = 4) -> int:
    """Cells a side of a picture of `size` pixels, half a cell or more left over at each border.

    These are the sizes of the thesis's heads: 20 at 84 px, 42 at 172 and 174 px.
    """
    return (size - cell) // cell


def centre_crop(x: Tensor, side: int) -> Tensor:
    """The square of `side` pixels in the middle of [...,H,W], as a view.

    Raises:
        UserError: the picture is smaller.
    """
    height, width = x.shape[-2:]
    if side > min(height, width):
        raise UserError(f'cells x cell = {side} pixels fit into the picture', (height, width),
                        'take fewer or smaller cells')
    top, left = (height - side) // 2, (width - side) // 2
    return x[..., top:top + side, left:left + side]


def pixel_change(images: Tensor, *, cell: int = 4, cells: int | None = None,
                 grey: bool = True) -> Tensor:
    """Pseudo-reward of pixel control: how much each cell changes in a step (thesis 4.3.2).

    Args:
        images: [T+1,B,3,H,W] uint8 RGB, consecutive pictures of one episode a column.
        cell: pixels a side of a cell; cells: how many a side, or None for `default_cells`.
        grey: difference of the grey-scale pictures, as the thesis says; False: mean over the
            differences of the colours, as the published code did.

    Returns:
        [T,B,cells,cells] float32 in [0, 1], the mean absolute difference.
    """
    if cells is None:
        cells = default_cells(images.shape[-1], cell)
    # Colours last, as pictures lie in memory.
    pixels = centre_crop(images, cells * cell).permute(0, 1, 3, 4, 2)
    if grey:
        weights = torch.tensor(GREY, device=images.device) / 255.0
        lightness = torch.mv(pixels.reshape(-1, 3).float(), weights).view(pixels.shape[:4])
        return F.avg_pool2d((lightness[1:] - lightness[:-1]).abs_(), cell)
    pixels = pixels.flatten(3)
    # Unsigned bytes: the difference without its sign, without a wider type.
    change = torch.maximum(pixels[1:], pixels[:-1]) - torch.minimum(pixels[1:], pixels[:-1])
    return F.avg_pool2d(change.float(), (cell, 3 * cell)) / 255.0


def average_pool_target(x: Tensor, cells: int, cell: int = 4) -> Tensor:
    """Target of an image head: [N,C,H,W] float, cropped and averaged to [N,C,cells,cells]."""
    return F.avg_pool2d(centre_crop(x, cells * cell), cell)


def label_target(labels: Tensor, colours: Tensor, cells: int, cell: int = 4) -> Tensor:
    """Target of a segmentation head (thesis 4.4): the average colour of each cell.

    Labels become colours before anything is averaged: between two classes lies no third one.

    Args:
        labels: [N,H,W] uint8 or uint16 classes.
        colours: [classes,3] float32, `label_colours`.
        cells, cell: as in `pixel_change`.

    Returns:
        [N,3,cells,cells] float32 in [0, 1].
    """
    cropped = centre_crop(labels, cells * cell).unflatten(2, (cells, cell))
    bags = cropped.unflatten(1, (cells, cell)).transpose(2, 3).reshape(-1, cell * cell).int()
    mean = F.embedding_bag(bags, colours, mode='mean')
    return mean.view(len(labels), cells, cells, 3).permute(0, 3, 1, 2)


def label_colours(count: int) -> Tensor:
    """Colours of classes, spread as far apart as possible in HSB (thesis 4.4).

    Distances are taken in the cone of hue, saturation and brightness, where all blacks are one
    point. Class 0 is black. Few colours are placed one by one; many lie on the lattice of the
    densest packing of balls, which then keeps more distance and takes no time.

    Returns:
        [count,3] float32 RGB in [0, 1]; equal on every call.

    Raises:
        UserError: more classes than a uint16 label has.
    """
    if not 1 <= count <= MAX_CLASSES:
        raise UserError(f'a label map has 1 to {MAX_CLASSES} classes', count,
                        'name fewer classes')
    return _placed_colours(count) if count <= CLASSES else _packed_colours(count)


def _placed_colours(count: int) -> Tensor:
    """Each colour in turn farthest from those before; then single ones move while that helps.

    Up to `CLASSES` of them these are the colours that published weights draw.
    """
    points, rgb = _candidates()
    distance = torch.cdist(points, points)
    chosen = [0]
    while len(chosen) < count:
        chosen.append(int(distance[chosen].amin(0).argmax()))
    for _ in range(20):
        moved = False
        for k in range(1, count):
            nearest = distance[chosen[:k] + chosen[k + 1:]].amin(0)
            best = int(nearest.argmax())
            if nearest[best] > nearest[chosen[k]] + 1e-6:
                chosen[k], moved = best, True
        if not moved:
            break
    return rgb[chosen]


def _packed_colours(count: int) -> Tensor:
    """Points of a face-centred cubic lattice in the HSB cone, as wide as leaves enough of them."""
    least, most = 0.0, 1.0  # half a diagonal of the lattice: enough points, too few
    for _ in range(30):
        middle = (least + most) / 2
        if middle > 0.01 and len(_lattice(middle)) < count:
            most = middle
        else:
            least = middle
    points = _lattice(least)
    # Neighbouring numbers are not neighbouring colours; the apex, black, stays the first.
    turn = (torch.arange(len(points), dtype=torch.float64) * ((math.sqrt(5) - 1) / 2)) % 1
    x, y, brightness = points[turn.argsort(stable=True)[:count]].unbind(1)
    return _rgb(torch.atan2(y, x) / (2 * math.pi) % 1, torch.hypot(x, y), brightness).float()


def _lattice(step: float) -> Tensor:
    """Points [N,3] of the HSB cone with whole coordinates of an even sum, in units of `step`."""
    across = torch.arange(-math.floor(1 / step), math.floor(1 / step) + 1)
    up = torch.arange(0, math.floor(1 / step) + 1)
    whole = torch.stack(torch.meshgrid(up, across, across, indexing='ij'), dim=-1).view(-1, 3)
    z, y, x = whole.unbind(1)
    return whole[(whole.sum(1) % 2 == 0) & (x * x + y * y <= z * z)].flip(1) * float(step)


def _rgb(hue: Tensor, chroma: Tensor, brightness: Tensor) -> Tensor:
    """RGB [N,3] of HSB: each channel falls from the brightness by the chroma, off its own hue."""
    sector = (torch.tensor([5.0, 3.0, 1.0], dtype=torch.float64) + 6 * hue[:, None]) % 6
    fall = torch.minimum(sector, 4 - sector).clamp(0, 1)
    return brightness[:, None] - chroma[:, None] * fall


def _candidates() -> tuple[Tensor, Tensor]:
    """Points of the HSB cone [N,3] and their RGB [N,3]; black is the first."""
    steps = torch.arange(1, LEVELS + 1, dtype=torch.float64) / LEVELS
    hue, saturation, brightness = torch.meshgrid(
        torch.arange(HUES, dtype=torch.float64) / HUES, steps, steps, indexing='ij')
    hue, saturation, brightness = hue.flatten(), saturation.flatten(), brightness.flatten()
    chroma = saturation * brightness
    angle = 2 * math.pi * hue
    points = torch.stack([chroma * angle.cos(), chroma * angle.sin(), brightness], dim=1)
    rgb = _rgb(hue, chroma, brightness)
    greys = torch.cat([torch.zeros(1, dtype=torch.float64), steps])
    on_axis = torch.stack([torch.zeros_like(greys), torch.zeros_like(greys), greys], dim=1)
    return (torch.cat([on_axis, points]),
            torch.cat([greys[:, None].expand(-1, 3), rgb]).float())
