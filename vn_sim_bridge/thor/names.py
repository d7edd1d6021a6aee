"""Names of AI2-THOR: its scenes, by split, and its object types as our classes."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping

from vn_sim_bridge.houses.labels import LABEL, LABELS

KINDS = {0: 'kitchens', 200: 'living rooms', 300: 'bedrooms', 400: 'bathrooms'}  # + 1 to 30
# Of each kind of room: as iTHOR's authors divide them.
RANGES = {'train': range(1, 21), 'validation': range(21, 26), 'test': range(26, 31)}
_ROBOTHOR = {'Train': (12, 5), 'Val': (3, 5)}  # rooms, and variants of each

SPLITS: Mapping[str, tuple[str, ...]] = {
    split: tuple(f'thor:FloorPlan{kind + k}' for kind in KINDS for k in numbers)
    for split, numbers in RANGES.items()}


@functools.cache
def scene_names() -> frozenset[str]:
    """Every scene of the Unity build that people may name."""
    robothor = (f'FloorPlan_{part}{room}_{variant}' for part, (rooms, variants)
                in _ROBOTHOR.items() for room in range(1, rooms + 1)
                for variant in range(1, variants + 1))
    return frozenset([f'FloorPlan{kind + k}' for kind in KINDS for k in range(1, 31)]
                     + list(robothor))


# Object types that are classes of the embedded houses under another name.
_SAME = {
    'CounterTop': 'counter', 'DeskLamp': 'lamp', 'FloorLamp': 'lamp', 'DiningTable': 'table',
    'GarbageCan': 'bin', 'HousePlant': 'plant', 'ArmChair': 'armchair', 'Painting': 'picture',
    'Poster': 'picture', 'ShelvingUnit': 'bookshelf', 'SideTable': 'nightstand',
    'SinkBasin': 'sink', 'BathtubBasin': 'bathtub', 'StoveBurner': 'stove', 'StoveKnob': 'stove',
    'ShowerDoor': 'shower', 'ShowerGlass': 'shower', 'ShowerHead': 'shower',
    'ShowerCurtain': 'shower', 'TeddyBear': 'teddy', 'Television': 'tv', 'TVStand': 'tv_stand',
    'BasketBall': 'ball', 'Doorway': 'door', 'Doorframe': 'door', 'LaundryHamper': 'basket',
    'LaundryHamperLid': 'basket', 'AlarmClock': 'clock', 'Footstool': 'stool',
}
_OWN = (
    'AluminumFoil', 'AppleSliced', 'BaseballBat', 'Blinds', 'Book', 'Boots', 'Bottle', 'Bowl',
    'Bread', 'BreadSliced', 'ButterKnife', 'Candle', 'CD', 'CellPhone', 'Cloth', 'CoffeeMachine',
    'CreditCard', 'Cup', 'Curtains', 'Desktop', 'DishSponge', 'DogBed', 'Drawer', 'Dumbbell',
    'Egg', 'EggCracked', 'Faucet', 'Fork', 'GarbageBag', 'HandTowel', 'HandTowelHolder', 'Kettle',
    'KeyChain', 'Knife', 'Ladle', 'Laptop', 'Lettuce', 'LettuceSliced', 'LightSwitch', 'Mug',
    'Newspaper', 'Pan', 'PaperTowelRoll', 'Pen', 'Pencil', 'PepperShaker', 'Pillow', 'Plate',
    'Plunger', 'Pot', 'Potato', 'PotatoSliced', 'RemoteControl', 'RoomDecor', 'Safe',
    'SaltShaker', 'ScrubBrush', 'Shelf', 'SoapBar', 'SoapBottle', 'Spatula', 'Spoon',
    'SprayBottle', 'Statue', 'TableTopDecor', 'TargetCircle', 'TennisRacket', 'TissueBox',
    'Toaster', 'ToiletPaper', 'ToiletPaperHanger', 'Tomato', 'TomatoSliced', 'Towel',
    'TowelHolder', 'VacuumCleaner', 'Watch', 'WateringCan', 'WineBottle',
)


def snake_case(name: str) -> str:
    """A name such as CoffeeTable as coffee_table."""
    return re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', name).lower()


# A class has one number in all of our simulators: the houses' classes come first.
LABEL_NAMES = (*LABELS, *map(snake_case, _OWN))
_CLASS = {name: index for index, name in enumerate(LABEL_NAMES)}


@functools.lru_cache(4096)
def class_of(name: str) -> int:
    """The class of what Unity calls 'Mug|-1.2|+0.9|+0.3' or 'wall_04'; unknown: 'object'."""
    kind = name.split('|')[0]
    if kind in _SAME:
        return LABEL[_SAME[kind]]
    if (plain := snake_case(kind)) in _CLASS:
        return _CLASS[plain]
    for part in ('wall', 'floor', 'ceiling', 'window', 'door'):  # parts of the building
        if part in plain:
            return LABEL[part]
    return LABEL['object']
