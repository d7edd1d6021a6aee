"""Files of grid scenes: the HDF5 dumps of Zhu et al. (ICRA 2017), and our own richer ones.

| data set | type, shape | meaning |
|---|---|---|
| `observation` | uint8 (N, H, W, 3) | RGB |
| `location` | float (N, 2) | x, z [m] of AI2-THOR's frame |
| `rotation` | (N,) | 0, 90, 180, 270 deg clockwise; may be absent |
| `graph` | int (N, A) | next state by action, -1: collision |
| `shortest_path_distance` | int (N, N) | steps, -1: unreachable; may be absent |
| `resnet_feature` | float32 (N, 10, F) or (N, F) | features of crops: the first; optional |
| `depth` | float (N, H, W) | m along the optical axis, 0: unknown; ours |
| `semantic` | uint8 (N, H, W) | class ids, names in its attribute `names`; ours |

Attributes, all optional: `actions` names the columns of the graph, `goals` the target states,
`camera_fov_deg` and `camera_height` [m] the camera.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from vn_nav.errors import UserError
from vn_nav.observation import preprocess, preprocess_map
from vn_nav.scenes import SceneName, options_of
from vn_sim_bridge.grid.states import COLUMNS, NAMES, count_steps, place_states

FOLDER = 'VN_NAV_GRID'  # environment variable: the folder of the scenes that have no path
OPTIONS = ('actions', 'distances', 'folder', 'goals')
# Target states of the thesis and of Zhu et al.
TARGETS = {
    'bathroom_02': (26, 37, 43, 53, 69), 'bedroom_04': (134, 264, 320, 384, 387),
    'kitchen_02': (90, 136, 157, 207, 329), 'living_room_08': (92, 135, 193, 228, 254),
}


@dataclasses.dataclass(frozen=True)
class GridScene:
    """A scene of N states, its pictures resized to the network's."""

    name: str
    poses: np.ndarray  # [N,4] x, y [m], yaw, pitch [rad]
    graph: np.ndarray  # [N,4] int64, see `states`
    steps: np.ndarray  # [N,N] int32, -1: no way
    step: float  # m, of a move
    goals: tuple[int, ...]  # states
    rgb: np.ndarray  # [N,3,S,S] uint8
    depth: np.ndarray | None  # [N,S,S] float32
    labels: np.ndarray | None  # [N,S,S] uint8
    label_names: tuple[str, ...]
    features: np.ndarray | None  # [N,F] float32


@dataclasses.dataclass(frozen=True)
class Facts:
    """What a file says without its pictures."""

    step: float  # m
    fov: float | None  # rad, of the pictures' shorter side; None: it does not say
    height: float | None  # m


def grid_path(scene: SceneName) -> Path:
    """The file of a scene: `grid:/path/file.h5`, or a name in the folder of such files.

    Raises:
        UserError: there is none.
    """
    options = options_of(scene, OPTIONS)
    place = Path(scene.place).expanduser()
    named = place.suffix in ('.h5', '.hdf5')
    if not named:
        folder = options.get('folder') or os.environ.get(FOLDER)
        if not folder:
            raise UserError('grid scenes are files in a folder that is named by the environment '
                            f'variable {FOLDER}', f'{scene}, and no {FOLDER}',
                            f'export {FOLDER}=/folder/of/dumps, or name a file: grid:/path/'
                            'file.h5 (docs/simulators/grid.md says where to get one)')
        place = Path(folder).expanduser() / f'{scene.place}.h5'
    if not place.is_file():
        raise UserError(f'the scene {scene} is in a file', f'no file {place}',
                        'see docs/simulators/grid.md for how to get or make it')
    return place


class _File:
    """An open file, its data sets checked as they are read."""

    def __init__(self, scene: SceneName):
        self.path, self.options = grid_path(scene), options_of(scene, OPTIONS)
        self.name = str(scene)
        try:
            self.file = h5py.File(self.path, 'r')
        except OSError as error:
            raise UserError('a grid scene is an HDF5 file', f'{self.path}: {error}',
                            'copy it again') from error
        self.count = 0  # N, of the first data set that is read

    def refuse(self, name: str, rule: str, received: object) -> UserError:
        """An error about a data set."""
        return UserError(f'the data set {name} of a grid scene {rule}',
                         f'{received} in {self.path}',
                         'copy the file again, or write it anew (vn_nav simulators dump)')

    def data(self, name: str, kinds: str, shape: str, *sides: int | None) -> h5py.Dataset | None:
        """A data set of N rows; None: it is absent.

        Args:
            name: of the data set.
            kinds: of its type, by the letters of NumPy's `dtype.kind`.
            shape: in words.
            sides: lengths of the axes behind the first; None: any.
        """
        if name not in self.file:
            return None
        found = self.file[name]
        if not isinstance(found, h5py.Dataset) or found.ndim != len(sides) + 1 or any(
                side not in (None, length)
                for side, length in zip(sides, found.shape[1:], strict=True)):
            raise self.refuse(name, f'has the shape {shape}', getattr(found, 'shape', 'a group'))
        if found.dtype.kind not in kinds:
            words = {'u': 'unsigned', 'i': 'whole', 'f': 'real', 'iu': 'whole', 'iuf': 'plain'}
            raise self.refuse(name, f'holds {words[kinds]} numbers', found.dtype)
        self.count = self.count or len(found)
        if len(found) != self.count:
            raise self.refuse(name, f'has a row for each of the {self.count} states of location',
                              f'{len(found)} rows')
        return found

    def needed(self, name: str, kinds: str, shape: str, *sides: int | None) -> h5py.Dataset:
        """A data set without which there is no scene."""
        found = self.data(name, kinds, shape, *sides)
        if found is None:
            raise self.refuse(name, 'is there', f'only {", ".join(self.file) or "nothing"}')
        return found

    def attribute(self, name: str, default=None):
        """Of the file."""
        return self.file.attrs.get(name, default)

    def states(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Poses [N,4], graph [N,4] and the length of a step."""
        location = self.needed('location', 'f', '(N, 2)', 2)[()].astype(float)
        if not self.count:
            raise self.refuse('location', 'has a row', 'none')
        if not np.isfinite(location).all():
            raise self.refuse('location', 'is finite', 'other numbers')
        read = self.needed('graph', 'iu', '(N, actions)', None)[()].astype(np.int64)
        if ((read < -1) | (read >= self.count)).any():
            wrong = read[(read < -1) | (read >= self.count)][0]
            raise self.refuse('graph', f'has states from 0 to {self.count - 1}, or -1', wrong)
        graph = np.full((self.count, 4), -1, np.int64)
        for column, name in enumerate(self._columns(read.shape[1])):
            graph[:, NAMES[name]] = read[:, column]
        rotation = self.data('rotation', 'iuf', '(N,)')
        turned = None
        if rotation is not None:
            turned = rotation[()].astype(float)
            if (turned % 90 != 0).any():
                raise self.refuse('rotation', 'has multiples of 90 degrees',
                                  turned[turned % 90 != 0][0])
        poses, step = place_states(location, graph, turned, str(self.path))
        return poses, graph, step

    def _columns(self, count: int) -> Sequence[str]:
        """Names of the graph's columns."""
        given = self.options.get('actions')
        names = given.split(',') if given else [
            part.decode() if isinstance(part, bytes) else str(part)
            for part in self.attribute('actions', COLUMNS if count == len(COLUMNS) else ())]
        done = [NAMES.get(name) for name in names]
        if len(names) != count or None in done or len(set(done)) != count:
            raise self.refuse(
                'graph', f'has a column for each action; they are some of {", ".join(NAMES)}',
                f'{count} columns named {", ".join(names) or "nothing"} (?actions=A,B,... names '
                'them)')
        return names

    def steps(self, graph: np.ndarray) -> np.ndarray:
        """[N,N] steps between states, of the graph; the file's have to agree."""
        own = count_steps(graph)
        choice = self.options.get('distances', 'file')
        if choice not in ('file', 'graph'):
            raise UserError('distances are those of the file or of the graph', choice,
                            '?distances=file or ?distances=graph')
        given = self.data('shortest_path_distance', 'iuf', '(N, N)', self.count)
        if given is not None and choice == 'file':
            other = np.count_nonzero(given[()] != own)
            if other:
                raise UserError('the data set shortest_path_distance is that of the graph',
                                f'{other} of {own.size} differ in {self.path}',
                                '?actions=... names the columns of the graph; ?distances=graph '
                                'takes those of the graph')
        return own

    def goals(self) -> tuple[int, ...]:
        """Target states."""
        given = self.options.get('goals')
        if given is not None:
            parts = given.split(',')
        else:
            parts = [str(int(goal)) for goal in np.ravel(self.attribute(
                'goals', TARGETS.get(self.path.stem, ())))]
        wrong = [part for part in parts if not part.isdecimal() or int(part) >= self.count]
        if wrong or not parts or len(set(map(int, parts))) != len(parts):
            raise UserError(f'goals of a grid scene are some of its states, 0 to '
                            f'{self.count - 1}, each once', f'{", ".join(parts) or "none"} for '
                            f'{self.name}', 'name them: ?goals=26,37')
        return tuple(map(int, parts))

    def facts(self, step: float) -> Facts:
        """Its camera."""
        fov, height = self.attribute('camera_fov_deg'), self.attribute('camera_height')
        return Facts(step, None if fov is None else math.radians(float(fov)),
                     None if height is None else float(height))

    def features(self) -> np.ndarray | None:
        """[N,F] of the first crop."""
        if 'resnet_feature' not in self.file:
            return None
        if getattr(self.file['resnet_feature'], 'ndim', 0) == 2:  # without the axis of crops
            rows = self.needed('resnet_feature', 'f', '(N, F)', None)[()]
        else:
            rows = self.needed('resnet_feature', 'f', '(N, crops, F)', None, None)[:, 0]
        if not np.isfinite(rows).all():
            raise self.refuse('resnet_feature', 'is finite', 'other numbers')
        return rows.astype(np.float32)


def read_facts(scene: SceneName) -> Facts:
    """What a file says of step and camera.

    Raises:
        UserError: no file, or one that is no grid scene.
    """
    opened = _File(scene)
    with opened.file:
        return opened.facts(opened.states()[2])


def read_grid(scene: SceneName, size: int, fov: float, height: float) -> GridScene:
    """A scene, all of it checked.

    Args:
        scene: its name.
        size: side of the square pictures [pixels].
        fov: of the robot's camera [rad]; height: of it [m]. A file that names a wider camera is
            cropped to it; one that names none is taken as it is.

    Raises:
        UserError: no file, one of another shape (which data set, and what is wrong with it), or
            another camera.
    """
    opened = _File(scene)
    with opened.file:
        poses, graph, step = opened.states()
        goals, facts = opened.goals(), opened.facts(step)
        if facts.height is not None and abs(facts.height - height) > 0.01:
            raise UserError(f'the camera of {opened.path} is {facts.height:g} m above the floor',
                            f'{height:g} m for the robot', 'leave out the robot file, or choose '
                            'another one')
        angles = {} if facts.fov is None else {'fov': facts.fov, 'target_fov': fov}
        pictures = opened.needed('observation', 'u', '(N, H, W, 3)', None, None, 3)
        if pictures.dtype != np.uint8 or min(pictures.shape[1:3]) < 8:
            raise opened.refuse('observation', 'is uint8 (N, H, W, 3), at least 8 pixels a side',
                                f'{pictures.dtype} {pictures.shape}')
        sides = pictures.shape[1:3]
        rgb = np.stack([preprocess(picture, size, **angles) for picture in pictures])
        maps: dict[str, np.ndarray | None] = {}
        for name, kind, kinds in (('depth', np.float32, 'f'), ('semantic', np.uint8, 'u')):
            rows = opened.data(name, kinds, '(N, H, W) as observation', *sides)
            maps[name] = None if rows is None else np.stack(
                [preprocess_map(row, size, **angles) for row in rows]).astype(kind)
        names: tuple[str, ...] = ()
        if maps['semantic'] is not None:
            names = tuple(map(str, opened.file['semantic'].attrs.get('names', ())))
            if maps['semantic'].max() >= len(names):
                raise opened.refuse('semantic', 'has an attribute names with a name for each '
                                    'class', f'{len(names)} names, class {maps["semantic"].max()}')
        return GridScene(opened.name, poses, graph, opened.steps(graph), step, goals, rgb,
                         maps['depth'], maps['semantic'], names, opened.features())
