"""Classes of SUNCG's models: `ModelCategoryMapping.csv`, and colours of classes.

The option `labels` of a scene chooses the column: `nyu40` (`nyuv2_40class`), `fine` or `coarse`.
Names are compared without case.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Mapping
from pathlib import Path

from vn_nav.errors import UserError

COLUMNS = {'nyu40': 'nyuv2_40class', 'fine': 'fine_grained_class',
           'coarse': 'coarse_grained_class'}
FILE = 'ModelCategoryMapping.csv'
NOTHING = 'nothing'
NYU40 = (
    'wall', 'floor', 'cabinet', 'bed', 'chair', 'sofa', 'table', 'door', 'window', 'bookshelf',
    'picture', 'counter', 'blinds', 'desk', 'shelves', 'curtain', 'dresser', 'pillow', 'mirror',
    'floor_mat', 'clothes', 'ceiling', 'books', 'refridgerator', 'television', 'paper', 'towel',
    'shower_curtain', 'box', 'whiteboard', 'person', 'night_stand', 'toilet', 'sink', 'lamp',
    'bathtub', 'bag', 'otherstructure', 'otherfurniture', 'otherprop')  # as SUNCG spells them
STRUCTURE = ('wall', 'floor', 'ceiling', 'ground', 'box')  # what has no model, beside `nyu40`
DOORS = ('door', 'fence', 'arch')  # of `nyu40`: House3D drives through them
PERSON = 'person'
MOST = 256  # classes that a pixel can name
# Coarse classes that tell a room's type: House3D's RoomNav.
ROOM_OBJECTS: Mapping[str, tuple[str, ...]] = {
    'kitchen': ('kitchen_appliance', 'hanging_kitchen_cabinet', 'kitchen_set', 'kitchenware',
                'kitchen_cabinet'),
    'dining_room': ('chair', 'table_and_chair', 'table'),
    'living_room': ('sofa', 'television'),
    'bathroom': ('shower', 'toilet', 'bathtub', 'bathroom_stuff'),
    'bedroom': ('bed',),
    'office': ('computer', 'desk', 'workplace'),
}
# The nearest that the 40 classes have.
NYU40_ROOM_OBJECTS: Mapping[str, tuple[str, ...]] = {
    'kitchen': ('counter', 'refridgerator'),
    'dining_room': ('chair', 'table'),
    'living_room': ('sofa', 'television'),
    'bathroom': ('toilet', 'bathtub', 'shower_curtain'),
    'bedroom': ('bed',),
    'office': ('desk',),
}


@dataclasses.dataclass(frozen=True)
class Model:
    """The classes of a model."""

    nyu40: str
    fine: str
    coarse: str

    @property
    def person(self) -> bool:
        """House3D and we leave them out."""
        return PERSON in (self.nyu40, self.fine, self.coarse)


class Categories:
    """The classes of all models, and the numbers of one column's.

    Args:
        path: of ModelCategoryMapping.csv.
        column: of COLUMNS.

    Raises:
        UserError: no such file or column, a file without its columns, or too many classes.
    """

    def __init__(self, path: Path, column: str = 'nyu40'):
        if column not in COLUMNS:
            raise UserError(f'labels are one of {", ".join(COLUMNS)}', column,
                            'choose one of them')
        self.path, self.column = path, column
        self._models: dict[str, Model] = {}
        for row in read_rows(path, ('model_id', *COLUMNS.values())):
            self._models[row['model_id']] = Model(*(row[name].strip().lower()
                                                    for name in COLUMNS.values()))
        names: tuple[str, ...] = NYU40
        if column != 'nyu40':
            found = {getattr(model, column) for model in self._models.values()
                     if not model.person} | set(STRUCTURE)
            names = tuple(sorted(found - {NOTHING, ''}))
        if len(names) >= MOST:
            raise UserError(f'a picture has at most {MOST - 1} classes',
                            f'{path}: {len(names)} in {COLUMNS[column]}',
                            'choose labels=nyu40 or labels=coarse')
        self.names = (NOTHING, *names)
        self._ids = {name: k for k, name in enumerate(self.names)}

    def model(self, model_id: str) -> Model:
        """The classes of a model.

        Raises:
            UserError: the file does not name it.
        """
        found = self._models.get(model_id)
        if found is None:
            raise UserError(f'{FILE} names every model of a house', f'{self.path}: {model_id}',
                            'take the file of the same release as the houses')
        return found

    def of_model(self, model_id: str) -> int:
        """The class id of a model."""
        name = getattr(self.model(model_id), self.column)
        # `void` is nyu40's word for nothing; a name beside the 40 is some other thing.
        other = 'otherprop' if self.column == 'nyu40' and name != 'void' else NOTHING
        return self._ids.get(name, self._ids[other])

    def of_structure(self, name: str) -> int:
        """The class id of wall, floor, ceiling, ground or box."""
        if self.column == 'nyu40' and name in ('ground', 'box'):
            name = 'otherstructure'
        return self._ids[name]

    def room_objects(self) -> dict[str, tuple[str, ...]]:
        """Classes that tell a room's type, in this column's names."""
        if self.column == 'nyu40':
            return dict(NYU40_ROOM_OBJECTS)
        if self.column == 'coarse':
            return {kind: tuple(name for name in names if name in self._ids)
                    for kind, names in ROOM_OBJECTS.items()}
        return {kind: tuple(sorted({model.fine for model in self._models.values()
                                    if model.coarse in names}))
                for kind, names in ROOM_OBJECTS.items()}


def read_rows(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """The rows of a CSV file.

    Raises:
        UserError: no such file, a column that is missing, or a row that is cut off.
    """
    try:
        with open(path, newline='', encoding='utf-8-sig') as file:
            reader = csv.DictReader(file)
            lacking = [name for name in columns if name not in (reader.fieldnames or ())]
            if lacking:
                raise UserError(f'{path.name} has the columns {", ".join(columns)}',
                                f'{path}: no {lacking[0]}', 'take the file of the data set')
            rows = []
            for row in reader:
                if any(row[name] is None for name in columns):
                    raise UserError(f'a row of {path.name} has {len(columns)} columns',
                                    f'{path}, line {reader.line_num}',
                                    'take the file of the data set')
                rows.append(row)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f'SUNCG has a {path.name} that can be read', f'{path}: {error}',
                        'copy it from the data set or from House3D/metadata') from error
    return rows


def read_colours(path: Path) -> dict[str, tuple[int, int, int]]:
    """Colours of classes: a file `name,r,g,b`; names in lower case.

    Raises:
        UserError: no such file, or a row that is no colour.
    """
    found = {}
    for row in read_rows(path, ('name', 'r', 'g', 'b')):
        try:
            colour = (int(row['r']), int(row['g']), int(row['b']))
        except ValueError as error:
            raise UserError('a colour map has whole numbers', f'{path}: {row}',
                            'take the file of House3D/metadata') from error
        if not all(0 <= value <= 255 for value in colour):
            raise UserError('colours are 0 to 255', f'{path}: {row["name"]} {colour}',
                            'take the file of House3D/metadata')
        found[row['name'].strip().lower()] = colour
    return found
