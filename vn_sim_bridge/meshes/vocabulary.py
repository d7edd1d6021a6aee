"""Classes of a simulator's meshes: ours first, then those that a data set adds."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.notices import say_once
from vn_sim_bridge.render.mesh_scene import MOST_LABELS

OTHER = 'object'  # whatever has no class of its own
# What data sets call our classes.
SYNONYMS = {
    'couch': 'sofa', 'loveseat': 'sofa', 'sofa_chair': 'armchair', 'arm_chair': 'armchair',
    'refrigerator': 'fridge', 'television': 'tv', 'tv_monitor': 'tv', 'monitor': 'tv',
    'tv_stand': 'tv_stand', 'night_stand': 'nightstand', 'bedside_table': 'nightstand',
    'dining_table': 'table', 'side_table': 'table', 'end_table': 'table', 'office_desk': 'desk',
    'bookcase': 'bookshelf', 'book_shelf': 'bookshelf', 'shelving': 'bookshelf',
    'potted_plant': 'plant', 'house_plant': 'plant', 'houseplant': 'plant',
    'bath_tub': 'bathtub', 'tub': 'bathtub', 'bath': 'bathtub', 'trash_can': 'bin',
    'garbage_can': 'bin', 'trashcan': 'bin', 'floor_lamp': 'lamp', 'desk_lamp': 'lamp',
    'table_lamp': 'lamp', 'lighting': 'lamp', 'countertop': 'counter', 'counter_top': 'counter',
    'kitchen_counter': 'counter', 'stovetop': 'stove', 'oven': 'stove', 'stove_burner': 'stove',
    'washing_machine': 'washing_machine', 'dining_chair': 'chair', 'office_chair': 'chair',
    'painting': 'picture', 'wall_decor': 'picture', 'carpet': 'rug', 'mat': 'rug',
    'chest_of_drawers': 'dresser', 'closet': 'wardrobe', 'kitchen_cabinet': 'cabinet',
    'doorway': 'door', 'doorframe': 'door', 'door_frame': 'door', 'shower_stall': 'shower',
    'suitcase': 'suitcase', 'teddy_bear': 'teddy', 'wall_clock': 'clock', 'footstool': 'ottoman',
    'kitchen_sink': 'sink', 'window_frame': 'window', 'unknown': OTHER, 'misc': OTHER,
    'objects': OTHER, 'void': 'nothing', 'unlabeled': OTHER, '': OTHER,
}


def class_name(text: str) -> str:
    """A category as our names are written: 'Dining Table' is 'table'."""
    spaced = re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', text.strip())
    name = re.sub(r'[^a-z0-9]+', '_', spaced.lower()).strip('_')
    return SYNONYMS.get(name, name)


class Vocabulary:
    """Names of classes and their numbers.

    Args:
        counts: categories beside ours, and how often each occurs. Where a pixel cannot name all
            of them the rarest are `OTHER`, and a line says so.
        whose: for that line.
    """

    def __init__(self, counts: Mapping[str, int] | None = None, whose: str = ''):
        own: dict[str, int] = {}
        for text, count in (counts or {}).items():
            own[class_name(text)] = own.get(class_name(text), 0) + count
        extra = sorted((name for name in own if name not in LABELS),
                       key=lambda name: (-own[name], name))
        room = MOST_LABELS - len(LABELS)
        if len(extra) > room:
            say_once(f'{whose} has {len(extra)} classes beside ours; the {room} most frequent '
                     f'keep their names, the others are "{OTHER}"')
        self.names: tuple[str, ...] = (*LABELS, *sorted(extra[:room]))
        self._ids = {name: k for k, name in enumerate(self.names)}

    def id(self, text: str | None) -> int:
        """The class of a category; that of `OTHER` where it is none."""
        return self._ids.get(class_name(text or ''), self._ids[OTHER])

    def of_names(self, names: Sequence[str | None]) -> int | None:
        """The class that one of some names begins with ('chair_3'); None: none does."""
        for name in names:
            if name:
                word = re.sub(r'[\W\d_]*$', '', name.split('#')[0].split('|')[0])
                while word:
                    found = self._ids.get(class_name(word))
                    if found is not None and class_name(word) not in (OTHER, 'nothing'):
                        return found
                    word = word.rpartition('_')[0]
        return None
