"""What houses are made of: colours, materials and furniture forms, in two looks that share none.

Training, validation and test houses have the `standard` look; the "unseen look" test split draws
from the other alone, so that success there cannot come from colours or shapes learned by heart.
"""

from __future__ import annotations

from typing import NamedTuple

from vn_sim_bridge.houses.textures import PAINTINGS, UNSEEN_PAINTINGS

Palette = tuple[tuple[float, float, float], ...]


class Look(NamedTuple):
    """Everything that a house draws its appearance from."""

    name: str
    woods: Palette
    fabrics: Palette
    whites: Palette  # ceramics, appliances, painted wood
    metals: Palette
    walls: Palette
    wet_floors: Palette
    wood: str  # texture of wooden parts
    cloth: tuple[str, ...]  # textures of upholstery
    wall_textures: tuple[str, ...]
    dry_floor_textures: tuple[str, ...]
    wet_floor_textures: tuple[str, ...]
    rug_textures: tuple[str, ...]
    fronts: tuple[str, ...]  # textures of doors and drawers
    paintings: tuple[str, ...]
    legs: tuple[str, ...]  # forms, see `piece.Piece`
    backs: tuple[str, ...]
    arms: tuple[str, ...]
    shades: tuple[str, ...]
    plants: tuple[str, ...]


STANDARD = Look(
    name='standard',
    woods=((0.72, 0.50, 0.30), (0.50, 0.33, 0.20), (0.85, 0.70, 0.48), (0.36, 0.24, 0.17)),
    fabrics=((0.70, 0.25, 0.22), (0.25, 0.38, 0.62), (0.35, 0.50, 0.34), (0.78, 0.66, 0.42),
             (0.45, 0.32, 0.52), (0.30, 0.56, 0.58), (0.82, 0.48, 0.25), (0.40, 0.42, 0.46)),
    whites=((0.95, 0.95, 0.93), (0.88, 0.90, 0.92), (0.96, 0.92, 0.84)),
    metals=((0.72, 0.74, 0.77), (0.30, 0.31, 0.33)),
    walls=((0.93, 0.90, 0.82), (0.80, 0.86, 0.90), (0.86, 0.90, 0.78), (0.94, 0.82, 0.76),
           (0.85, 0.80, 0.90), (0.96, 0.92, 0.66), (0.72, 0.82, 0.80), (0.90, 0.70, 0.62)),
    wet_floors=((0.92, 0.92, 0.90), (0.80, 0.86, 0.90), (0.86, 0.80, 0.70), (0.72, 0.82, 0.80)),
    wood='wood',
    cloth=('fabric', 'weave'),
    wall_textures=('plaster', 'plain', 'stripes', 'dots', 'brick', 'leafy', 'plaster'),
    dry_floor_textures=('planks', 'parquet', 'carpet', 'planks'),
    wet_floor_textures=('tiles', 'checker', 'marble'),
    rug_textures=('dots', 'stripes', 'weave', 'medallion'),
    fronts=('door', 'drawers', 'twin'),
    paintings=tuple(f'painting_{i}' for i in range(PAINTINGS)),
    legs=('square', 'round', 'panel'),
    backs=('solid', 'slats'),
    arms=('box', 'slim'),
    shades=('cone', 'drum'),
    plants=('bush', 'tall'),
)

UNSEEN = Look(
    name='unseen',
    woods=((0.62, 0.42, 0.36), (0.24, 0.22, 0.21), (0.78, 0.76, 0.70), (0.58, 0.52, 0.40)),
    fabrics=((0.85, 0.62, 0.66), (0.16, 0.22, 0.34), (0.60, 0.70, 0.40), (0.62, 0.44, 0.30),
             (0.78, 0.78, 0.80), (0.22, 0.40, 0.36), (0.90, 0.76, 0.30), (0.55, 0.18, 0.36)),
    whites=((0.80, 0.86, 0.82), (0.90, 0.80, 0.78), (0.70, 0.72, 0.76)),
    metals=((0.80, 0.66, 0.38), (0.52, 0.40, 0.34)),
    walls=((0.66, 0.74, 0.62), (0.60, 0.68, 0.80), (0.88, 0.84, 0.74), (0.74, 0.62, 0.66),
           (0.92, 0.78, 0.56), (0.58, 0.62, 0.60), (0.80, 0.72, 0.84), (0.97, 0.95, 0.94)),
    wet_floors=((0.60, 0.66, 0.70), (0.82, 0.70, 0.62), (0.70, 0.76, 0.66), (0.94, 0.88, 0.80)),
    wood='knotty',
    cloth=('plaid', 'corduroy'),
    wall_textures=('concrete', 'damask', 'bands', 'panels', 'concrete'),
    dry_floor_textures=('herringbone', 'cork', 'diamonds'),
    wet_floor_textures=('hexagons', 'terrazzo'),
    rug_textures=('plaid', 'diamonds', 'rings'),
    fronts=('louvre', 'grooves'),
    paintings=tuple(f'painting_{PAINTINGS + i}' for i in range(UNSEEN_PAINTINGS)),
    legs=('sled', 'pedestal'),
    backs=('ladder', 'frame'),
    arms=('sloped', 'none'),
    shades=('globe', 'flat'),
    plants=('palm', 'cactus'),
)
