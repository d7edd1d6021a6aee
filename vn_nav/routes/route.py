"""A route as a folder: pictures along a way, numbered in its order, and names of places on it.

`0.jpg`, `1.jpg`, ... JPEG, PNG or HEIC; numbers may be left out. A folder of ViNT, NoMaD and GNM
(`topomaps/images/NAME`, https://github.com/robodhruv/visualnav-transformer) is one as it is.
`route.yaml` beside the pictures, if there is one:

    places: {kitchen: 12, desk: 0}  # numbers of pictures
    camera_fov: 62.0  # deg, of the shorter side; left out: as of the robot's camera
"""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import yaml

from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.goal_picture import read_goal_picture
from vn_nav.structured_file import read_yaml

FILE = 'route.yaml'
SUFFIXES = ('.jpg', '.jpeg', '.png', '.heic', '.heif')
MOST = 2000  # pictures
FOV_DEG = 5.0, 170.0
REMEDY = 'write one with `vn_nav route BAG --out FOLDER`, or give a topomap of ViNT or NoMaD'


@dataclasses.dataclass(frozen=True)
class Route:
    """Pictures along a way.

    Attributes:
        numbers: of the pictures, as their files say, ascending; files: theirs.
        places: names, and numbers of their pictures.
        fov: of the pictures' shorter side [rad]; None: as of the robot's camera.
    """

    folder: Path
    numbers: tuple[int, ...]
    files: tuple[Path, ...]
    places: dict[str, int]
    fov: float | None = None

    def __len__(self) -> int:
        return len(self.files)

    def index(self, place: str) -> int:
        """Which picture shows a place.

        Args:
            place: its name, or the number of the picture; empty: the last one.

        Raises:
            UserError: no such place.
        """
        number = self.places.get(place)
        if number is None and re.fullmatch(r'\d{1,9}', place):
            number = int(place)
        if number is None and not place:
            return len(self) - 1
        if number not in self.numbers:
            raise UserError('a place is one of the route, or the number of a picture',
                            repr(place[:60]), f'places of {self.folder}: {self.named()}; '
                            f'pictures: {self.numbers[0]} to {self.numbers[-1]}')
        return self.numbers.index(number)

    def name(self, index: int) -> str:
        """What a picture is called."""
        number = self.numbers[index]
        return next((name for name, own in self.places.items() if own == number), str(number))

    def named(self) -> str:
        """The names, for people."""
        return ', '.join(self.places) or 'none has a name'

    def picture(self, index: int):
        """A picture [H,W,3] uint8 RGB, and the field of view of its shorter side [rad] or None.

        Raises:
            UserError: the file cannot be read.
        """
        picture, fov = read_goal_picture(self.files[index])
        return picture, fov if self.fov is None else self.fov


def is_route(folder: Path) -> bool:
    """Whether a folder holds numbered pictures, rather than a bag."""
    return folder.is_dir() and bool(_pictures(folder))


def read_route(folder: str | Path) -> Route:
    """The route of a folder; its pictures are not opened.

    Raises:
        UserError: no numbered pictures, two with one number, or a `route.yaml` that does not fit.
    """
    folder = Path(folder)
    found = _pictures(folder) if folder.is_dir() else []
    if not found:
        raise UserError('a route is a folder of pictures that are called by numbers: 0.jpg, 1.jpg',
                        f'{folder}: {"none" if folder.is_dir() else "no such folder"}', REMEDY)
    numbers = tuple(number for number, _ in found)
    for number, following in zip(numbers, numbers[1:], strict=False):
        if number == following:
            raise UserError('each picture of a route has a number of its own',
                            f'{folder}: {number} twice', 'remove one of them')
    if len(found) > MOST:
        raise UserError(f'a route has at most {MOST} pictures', f'{folder}: {len(found)}',
                        'leave out every other one')
    places, fov = _names(folder / FILE, numbers)
    return Route(folder, numbers, tuple(path for _, path in found), places, fov)


def with_places(route: Route, places: dict[str, str]) -> Route:
    """A route with more names, written to its folder.

    Args:
        route: that gets them.
        places: names, and numbers of pictures, or `first` and `last`.

    Raises:
        UserError: a name that is none, or no such picture.
    """
    ends = {'first': str(route.numbers[0]), 'last': str(route.numbers[-1])}
    named = dict(route.places)
    for name, number in places.items():
        _check_name(name, f'--name {name}={number}')
        named[name] = route.numbers[route.index(ends.get(number, number) or '-')]
    changed = dataclasses.replace(route, places=named)
    write_names(changed)
    return changed


def write_names(route: Route) -> None:
    """Write `route.yaml`."""
    said: dict = {'places': route.places}
    if route.fov is not None:
        said['camera_fov'] = round(math.degrees(route.fov), 3)
    write_file(route.folder / FILE, yaml.safe_dump(said, sort_keys=False,
                                                   allow_unicode=True).encode())


def _pictures(folder: Path) -> list[tuple[int, Path]]:
    """Numbers and files, in the order of the numbers."""
    return sorted((int(path.stem), path) for path in folder.iterdir()
                  if path.suffix.lower() in SUFFIXES and re.fullmatch(r'\d{1,9}', path.stem))


def _names(path: Path, numbers: tuple[int, ...]) -> tuple[dict[str, int], float | None]:
    if not path.exists():
        return {}, None
    said = read_yaml(path, 'a route file', 'correct it, or remove it')
    places, fov = said.get('places') or {}, said.get('camera_fov')
    if set(said) - {'places', 'camera_fov'} or not isinstance(places, dict):
        raise UserError('a route file has places, names and numbers of pictures, and camera_fov',
                        f'{path}: {", ".join(map(str, said))}', 'correct it')
    for name, number in places.items():
        _check_name(name, str(path))
        if type(number) is not int or number not in numbers:
            raise UserError('a place of a route is the number of a picture in its folder',
                            f'{path}: {name}: {number!r}', 'correct it')
    if fov is not None and not (isinstance(fov, (int, float)) and not isinstance(fov, bool)
                                and FOV_DEG[0] <= fov <= FOV_DEG[1]):
        raise UserError(f'camera_fov of a route is {FOV_DEG[0]:g} to {FOV_DEG[1]:g} deg',
                        f'{path}: {fov!r}', 'correct it')
    return places, None if fov is None else math.radians(fov)


def _check_name(name: object, where: str) -> None:
    if not isinstance(name, str) or not name.strip() or name != name.strip() or (
            re.fullmatch(r'\d+', name)):
        raise UserError('a place has a name that is no number', f'{where}: {name!r}',
                        'choose another name')
