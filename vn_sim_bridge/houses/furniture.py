"""The kinds of furniture: how large each is, how it is drawn, and which rooms it stands in."""

from __future__ import annotations

import dataclasses

from vn_sim_bridge.houses.fixtures import FIXTURES
from vn_sim_bridge.houses.movables import MOVABLES

DRAWINGS = FIXTURES | MOVABLES  # by kind: functions of a piece, its width, depth and height [m]


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of furniture: sizes [m] are (least, most); depth is measured from the wall."""

    width: tuple[float, float]
    depth: tuple[float, float]
    height: tuple[float, float]
    standing: float = 0.0  # m beyond `depth` that belongs to it (a desk's chair)
    centre: bool = False  # stands in the middle of a room rather than at a wall


KINDS = {
    'bed': Kind((1.4, 1.8), (2.0, 2.1), (0.8, 1.1)),
    'nightstand': Kind((0.4, 0.5), (0.35, 0.45), (0.45, 0.6)),
    'wardrobe': Kind((1.0, 1.8), (0.55, 0.62), (1.9, 2.2)),
    'desk': Kind((1.2, 1.5), (0.65, 0.75), (0.72, 0.76), standing=0.45),
    'dining': Kind((1.3, 1.7), (1.75, 1.95), (0.72, 0.76), centre=True),
    'round_table': Kind((1.7, 1.9), (1.1, 1.2), (0.72, 0.76), centre=True),
    'sofa': Kind((1.7, 2.2), (0.85, 0.95), (0.75, 0.9)),
    'armchair': Kind((0.8, 0.9), (0.8, 0.9), (0.85, 0.95)),
    'tv': Kind((1.3, 1.7), (0.4, 0.45), (0.45, 0.6)),
    'bookshelf': Kind((0.8, 1.4), (0.3, 0.35), (1.6, 2.1)),
    'counter': Kind((1.8, 2.6), (0.6, 0.62), (0.9, 0.92)),
    'fridge': Kind((0.6, 0.75), (0.62, 0.68), (1.6, 1.9)),
    'toilet': Kind((0.42, 0.46), (0.65, 0.66), (0.8, 0.9)),
    'bathtub': Kind((1.5, 1.7), (0.7, 0.75), (0.5, 0.6)),
    'shower': Kind((0.8, 0.95), (0.8, 0.9), (2.0, 2.1)),
    'washbasin': Kind((0.55, 0.8), (0.42, 0.5), (0.85, 0.9)),
    'washing_machine': Kind((0.6, 0.6), (0.58, 0.6), (0.85, 0.87)),
    'plant': Kind((0.5, 0.7), (0.5, 0.7), (1.1, 1.6)),
    'lamp': Kind((0.4, 0.48), (0.4, 0.48), (1.5, 1.7)),
    'cabinet': Kind((0.8, 1.3), (0.4, 0.48), (0.8, 1.2)),
    'dresser': Kind((0.9, 1.2), (0.42, 0.5), (0.75, 0.9)),
    'coffee_table': Kind((0.8, 1.1), (0.5, 0.6), (0.4, 0.45), centre=True),
    'ottoman': Kind((0.5, 0.7), (0.5, 0.6), (0.38, 0.45)),
    'bin': Kind((0.3, 0.36), (0.3, 0.36), (0.4, 0.6)),
    'boxes': Kind((0.5, 0.7), (0.45, 0.6), (0.5, 0.9)),
    'piano': Kind((1.4, 1.5), (0.95, 1.05), (1.1, 1.25)),
    'coat_rack': Kind((0.4, 0.45), (0.4, 0.45), (1.7, 1.9)),
    'bench': Kind((0.9, 1.3), (0.35, 0.42), (0.42, 0.46)),
    'aquarium': Kind((0.8, 1.1), (0.38, 0.45), (1.15, 1.35)),
    'radiator': Kind((0.8, 1.2), (0.11, 0.14), (0.6, 0.75)),
    'fireplace': Kind((1.2, 1.5), (0.35, 0.42), (1.0, 1.2)),
    'whiteboard': Kind((1.0, 1.4), (0.4, 0.45), (1.8, 1.95)),
}
TALL = ('wardrobe', 'bookshelf', 'fridge', 'counter', 'washbasin', 'shower', 'dresser', 'tv',
        'fireplace', 'whiteboard', 'aquarium', 'piano')  # nothing hangs on the wall behind these

# What stands in a room of each type, most important first; the part after None only sometimes.
ROOM_PROGRAMMES = {
    'living_room': ('sofa', 'tv', 'coffee_table', 'bookshelf', 'armchair', 'plant', 'lamp', None,
                    'fireplace', 'piano', 'aquarium', 'ottoman', 'radiator', 'cabinet'),
    'kitchen': ('counter', 'fridge', 'round_table', 'bin', None, 'cabinet', 'plant', 'radiator'),
    'bedroom': ('bed', 'nightstand', 'wardrobe', 'dresser', 'lamp', None, 'armchair', 'plant',
                'bench', 'radiator', 'bookshelf', 'boxes'),
    'bathroom': ('toilet', 'washbasin', 'bathtub', 'shower', 'washing_machine', None, 'bin',
                 'cabinet', 'radiator'),
    'dining_room': ('dining', 'cabinet', 'plant', 'lamp', None, 'bookshelf', 'fireplace', 'piano',
                    'radiator', 'dresser'),
    'office': ('desk', 'bookshelf', 'bookshelf', 'whiteboard', 'bin', None, 'armchair', 'boxes',
               'plant', 'lamp', 'cabinet', 'radiator'),
    'hall': ('coat_rack', 'bench', 'cabinet', None, 'plant', 'bookshelf', 'boxes', 'aquarium',
             'radiator'),
}
OPTIONAL_PROBABILITY = 0.45
