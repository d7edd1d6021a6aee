"""The texture library: the same small tiling pictures for every house.

Houses vary by which textures they use and by the colours that multiply them.
"""

from __future__ import annotations

import functools

import numpy as np

from vn_sim_bridge.houses.materials import MATERIALS, painting
from vn_sim_bridge.houses.unseen_materials import UNSEEN_MATERIALS
from vn_sim_bridge.render.scene import TextureSet

PAINTINGS = 32  # distinct pictures for walls
UNSEEN_PAINTINGS = 12  # more of them, for the unseen look

# The position of a texture seeds its random numbers: the order is part of every house.
_RECIPES = MATERIALS | UNSEEN_MATERIALS | {
    f'painting_{i}': painting for i in range(PAINTINGS + UNSEEN_PAINTINGS)}

TEXTURES = {name: index for index, name in enumerate(_RECIPES)}


@functools.cache
def texture_library() -> TextureSet:
    """All textures, one object for every house."""
    pictures = [recipe(np.random.default_rng(1000 + index))
                for index, recipe in enumerate(_RECIPES.values())]
    return TextureSet([np.clip(picture * 255, 0, 255).round().astype(np.uint8)
                       for picture in pictures])
