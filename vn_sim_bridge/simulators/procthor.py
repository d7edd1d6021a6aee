"""ProcTHOR houses: `procthor:house.json`, `procthor:train.jsonl.gz?index=3`, `index=0-99`."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import re
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from vn_nav.errors import UserError
from vn_nav.scenes import SceneName, options_of
from vn_sim_bridge.meshes.house_file import HouseFile
from vn_sim_bridge.meshes.place import MeshPlace, PlaceRules, make_place
from vn_sim_bridge.meshes.procthor import house_surfaces
from vn_sim_bridge.meshes.simulator import MeshSimulator
from vn_sim_bridge.meshes.thor_sizes import SIZES
from vn_sim_bridge.meshes.vocabulary import Vocabulary
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.simulator import Setup

OPTIONS = ('index', 'meshes', 'assets', 'doors')
REMEDY = 'take a house of ProcTHOR-10K; docs/simulators/procthor.md says where to get them'


class ProcthorSimulator(MeshSimulator):
    """Robots in ProcTHOR's houses."""

    version = '2'  # 1: the map was turned by a quarter against that of the simulator thor

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> ProcthorSimulator:
        """See `BaseSimulator.open`."""
        found = [one for scene in scenes for one in _expanded(scene)]
        files = _files(found)
        # One list of classes for every house: AI2-THOR's types.
        vocabulary = Vocabulary(dict.fromkeys(SIZES, 1), 'ProcTHOR')
        return cls([str(one) for one in found],
                   [functools.partial(_make, one, files[one.place], setup, vocabulary)
                    for one in found], setup, vocabulary.names)


def _expanded(scene: SceneName) -> list[SceneName]:
    """One house, or those of a range of numbers.

    Raises:
        UserError: no such file, or an option that is none.
    """
    options = options_of(scene, OPTIONS)
    path = Path(scene.place).expanduser()
    if not path.is_file():
        raise UserError('a scene of procthor is a file: .json, .jsonl, or these as .gz',
                        str(scene), REMEDY)
    for name in ('meshes', 'assets'):
        if name in options and not (Path(options[name]).is_dir() if name == 'meshes' else
                                    Path(options[name]).is_file()):
            raise UserError(f'the {"folder" if name == "meshes" else "file"} of the option {name} '
                            'exists', options[name], 'correct it')
    if options.get('doors', 'open') not in ('open', 'as_given'):
        raise UserError('doors are open or as_given', str(scene), 'choose one of them')
    lines = '.jsonl' in path.suffixes
    index = options.get('index', '0' if not lines else None)
    span = re.fullmatch(r'(\d{1,9})(?:-(\d{1,9}))?', index or '')
    if span is None or (not lines and 'index' in options):
        raise UserError('a file with many houses needs index=NUMBER or index=FIRST-LAST, one with '
                        'a single house none', str(scene), 'for instance train.jsonl.gz?index=3')
    if not lines:
        return [scene]
    first, last = int(span[1]), int(span[2] or span[1])
    if last < first or last - first >= 100_000:
        raise UserError('a range of houses is FIRST-LAST', str(scene), 'correct it')
    return [scene._replace(options=tuple(sorted({**options, 'index': str(k)}.items())))
            for k in range(first, last + 1)]


def _make(scene: SceneName, file: HouseFile, setup: Setup, vocabulary: Vocabulary
          ) -> tuple[MeshPlace, Scene]:
    """Read a house."""
    options = dict(scene.options)
    made = house_surfaces(
        read_house(scene, file), vocabulary, str(scene), boxes=_boxes(options.get('assets')),
        meshes=Path(options['meshes']) if 'meshes' in options else None,
        doors_as_given=options.get('doors') == 'as_given')
    return make_place(str(scene), made.surfaces, vocabulary.names, setup.robot, rooms=made.rooms,
                      rules=PlaceRules(floor_z=0.0), goals_per_room=setup.goals_per_room,
                      goal_seed=setup.goal_seed)


def _files(scenes: Sequence[SceneName]) -> dict[str, HouseFile]:
    """The files of some houses, passed through once: each has the last that is asked of it.

    Raises:
        UserError: it has not, or it cannot be read.
    """
    last: dict[str, SceneName] = {}
    for scene in scenes:
        if scene.place not in last or _index(scene) > _index(last[scene.place]):
            last[scene.place] = scene
    files = {place: HouseFile(Path(place).expanduser()) for place in last}
    for place, scene in last.items():
        with _whole(scene):
            if not files[place].has(_index(scene)):
                raise UserError(f'{files[place].path.name} has a house of that number', str(scene),
                                'choose a smaller index')
    return files


def _index(scene: SceneName) -> int:
    return int(dict(scene.options).get('index', 0))


@contextlib.contextmanager
def _whole(scene: SceneName) -> Iterator[None]:
    """What reading a house raises, in a line."""
    try:
        yield
    except (OSError, EOFError, zlib.error, ValueError, RecursionError) as error:
        raise UserError('a house of ProcTHOR is whole JSON', f'{scene}: {error}',
                        REMEDY) from error


def read_house(scene: SceneName, file: HouseFile) -> dict:
    """The JSON of a house.

    Raises:
        UserError: no whole file, or not so many houses in it.
    """
    with _whole(scene):
        house = json.loads(file.text(_index(scene)) or b'')
    if not isinstance(house, dict) or not isinstance(house.get('rooms'), list):
        raise UserError('a house of ProcTHOR is an object with rooms', str(scene), REMEDY)
    return house


@functools.lru_cache(2)
def _boxes(path: str | None) -> dict[str, tuple[float, float, float]]:
    """Sizes by the assets' ids: of a table of procthor's form, or of the installed package.

    Raises:
        UserError: another file.
    """
    if path is None:
        package = importlib.util.find_spec('procthor')
        found = package and package.submodule_search_locations
        table = Path(found[0]) / 'databases' / 'asset-database.json' if found else None
        if table is None or not table.is_file():
            return {}
        path = str(table)
    try:
        table = json.loads(Path(path).read_text('utf-8'))
        return {str(asset['assetId']): (float(asset['boundingBox']['x']),
                                        float(asset['boundingBox']['y']),
                                        float(asset['boundingBox']['z']))
                for assets in table.values() for asset in assets}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError('a table of assets is {type: [{assetId, boundingBox: {x, y, z}}]}',
                        f'{path}: {error}', 'take asset-database.json of procthor') from error


SIMULATOR = ProcthorSimulator
