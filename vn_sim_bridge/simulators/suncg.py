"""Houses in SUNCG's format, drawn by our renderer: `suncg:HOUSE_ID?level=0&labels=nyu40`.

The data set was withdrawn in 2019; who holds a copy names its folder in SUNCG_PATH. `vn_nav house
export --suncg DIR` writes houses of our own in this format. See docs/simulators/suncg.md.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vn_nav.errors import UserError
from vn_nav.scenes import SceneName, options_of, whole_number
from vn_sim_bridge.meshes.simulator import MeshSimulator
from vn_sim_bridge.simulator import Frames, Setup
from vn_sim_bridge.suncg.labels import FILE, Categories
from vn_sim_bridge.suncg.place import OBSTACLES, Options, read_place

FOLDER = 'SUNCG_PATH'
OPTIONS = ('data', 'level', 'labels', 'obstacles', 'targets', 'layout', 'depth')
COMMON = {'data': '', 'labels': 'nyu40', 'depth': 'metres'}  # one for all scenes
DEPTH_SCALE = 20.0  # m, that House3D's 255 stands for
REMEDY = f'set {FOLDER} to the folder with house, room, object and texture, or add ?data=FOLDER ' \
    'to the scene; the data set is not for download: docs/simulators/suncg.md'


class SuncgSimulator(MeshSimulator):
    """Robots in houses of SUNCG's format (see `MeshSimulator`)."""

    # Objects to place have classes of their own, which a SUNCG house has not.
    capabilities = dataclasses.replace(MeshSimulator.capabilities, placeable_objects=False)
    house3d_depth = False  # as House3D quantises it

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> SuncgSimulator:
        """See `BaseSimulator.open`."""
        data, labels, depth = (_common(scenes, name, default)
                               for name, default in COMMON.items())
        if depth not in ('metres', 'house3d'):
            raise UserError('depth is metres or house3d', depth, 'choose one of them')
        folder = data_folder(data)
        categories = Categories(categories_file(folder), labels)
        makers = []
        for scene in scenes:
            if not (folder / 'house' / scene.place / 'house.json').is_file():
                raise UserError('a scene of suncg is a house of the data set', str(scene),
                                f'there is no {folder / "house" / scene.place}/house.json; '
                                + REMEDY)
            makers.append(functools.partial(
                read_place, str(scene), folder, scene.place, categories, setup.robot,
                options=_options(scene), goals_per_room=setup.goals_per_room,
                goal_seed=setup.goal_seed))
        self = cls([str(scene) for scene in scenes], makers, setup, categories.names)
        self.room_objects = categories.room_objects()
        self.house3d_depth = depth == 'house3d'
        return self

    def _draw(self, *arguments) -> Frames:
        frames = super()._draw(*arguments)
        if self.house3d_depth:
            frames.depth[:] = quantised(frames.depth)
        return frames


def quantised(depth: np.ndarray) -> np.ndarray:
    """Depths [m] in House3D's steps of 20 m / 255; all beyond 20 m is 20 m."""
    return np.rint(np.minimum(depth, DEPTH_SCALE) * (255 / DEPTH_SCALE)) * (DEPTH_SCALE / 255)


def data_folder(given: str = '') -> Path:
    """The folder of the data set.

    Args:
        given: by the scene; '': by SUNCG_PATH.

    Raises:
        UserError: none is named, or there is no such folder.
    """
    text = given or os.environ.get(FOLDER, '')
    if not text:
        raise UserError('scenes of suncg need the data set', f'no {FOLDER}', REMEDY)
    folder = Path(text).expanduser()
    if not (folder / 'house').is_dir():
        raise UserError('the folder of SUNCG has a folder house', text, REMEDY)
    return folder


def categories_file(folder: Path) -> Path:
    """The file of the models' classes: beside the houses, or in metadata/.

    Raises:
        UserError: neither.
    """
    for path in (folder / FILE, folder / 'metadata' / FILE):
        if path.is_file():
            return path
    raise UserError(f'the folder of SUNCG has a {FILE}', str(folder),
                    'copy it from the data set, or from House3D/metadata')


def _common(scenes: Sequence[SceneName], name: str, default: str) -> str:
    """An option that is one for all scenes."""
    values = {options_of(scene, OPTIONS).get(name, default) for scene in scenes}
    if len(values) > 1:
        raise UserError(f'scenes that are opened together have one {name}',
                        ', '.join(sorted(values)), 'give the same to all')
    return values.pop()


def _options(scene: SceneName) -> Options:
    given = dict(scene.options)
    options = Options(level=whole_number(scene, 'level', given.get('level', '0')),
                      obstacles=given.get('obstacles', 'mesh'),
                      targets=given.get('targets', 'house3d'), layout=given.get('layout', ''))
    if options.obstacles not in OBSTACLES or options.targets not in ('house3d', 'all'):
        raise UserError(f'obstacles are one of {", ".join(OBSTACLES)}, targets house3d or all',
                        str(scene), 'correct the options')
    return options


SIMULATOR = SuncgSimulator
