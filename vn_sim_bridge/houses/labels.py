"""The classes that the pictures' labels name; label 0 is empty space."""

LABELS = (
    'nothing', 'wall', 'floor', 'ceiling', 'door', 'window', 'picture', 'rug', 'bed', 'nightstand',
    'wardrobe', 'desk', 'chair', 'table', 'sofa', 'armchair', 'tv', 'tv_stand', 'bookshelf',
    'counter', 'fridge', 'stove', 'sink', 'toilet', 'bathtub', 'washbasin', 'plant', 'lamp',
    'cabinet', 'stool', 'mirror', 'bin', 'coffee_table', 'washing_machine', 'box', 'piano',
    'dresser', 'shower', 'coat_rack', 'bench', 'aquarium', 'radiator', 'clock', 'fireplace',
    'microwave', 'whiteboard', 'ottoman', 'apple', 'lemon', 'ball', 'teddy', 'vase', 'suitcase',
    'toy_car', 'book_pile', 'basket', 'object',
)
LABEL = {name: index for index, name in enumerate(LABELS)}
