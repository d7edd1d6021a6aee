"""The simulators by name: a table that imports none of them before it is asked for.

A simulator outside this package registers itself, without a change here, in either way:

- an entry point of the group `vn_nav.simulators` in its own package:
  `corridor = my_robot.corridor`;
- its module's name, with a dot, in front of the scene: `examples.corridor:8`.

Such a module has a class `SIMULATOR` (see `vn_sim_bridge.simulator.BaseSimulator`).
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import importlib.util
import subprocess
import sys
from collections.abc import Sequence

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_nav.scenes import one_simulator
from vn_sim_bridge.simulator import BaseSimulator, Setup, Simulator

GROUP = 'vn_nav.simulators'  # of entry points


@dataclasses.dataclass(frozen=True)
class Entry:
    """A row of the table."""

    module: str  # has the class SIMULATOR
    about: str  # what it is, in a line
    scene: str  # an example of a scene's name
    needs: tuple[str, ...] = ()  # modules that are not always installed
    install: str = ''  # the command that installs them
    pip: tuple[tuple[str, ...], ...] = ()  # what `vn_nav simulators install` asks pip for, in turn
    setup: str = ''  # or a module with `missing()` and `install(system)`, where pip will not do


# The client of AI2-THOR and what it needs, but for opencv-python: that lies in the folder of
# opencv-python-headless, and needs libGL, which a machine without a display may lack.
THOR = (('aws-requests-auth', 'botocore', 'flask', 'msgpack', 'pillow', 'progressbar2',
         'python-xlib', 'requests', 'werkzeug'), ('--no-deps', 'ai2thor>=5,<6'))
TABLE = {
    'house': Entry('vn_sim_bridge.simulators.house', 'procedural houses, drawn by this package',
                   'house:7?rooms=5'),
    'bag': Entry('vn_sim_bridge.simulators.recorded',
                 'the pictures of a recorded drive (depth where it has some)', 'bag:my_drive'),
    'gltf': Entry('vn_sim_bridge.simulators.gltf',
                  "scenes of GLB, glTF and OBJ files, and of Habitat's data sets",
                  'gltf:flat.glb', ('PIL',), 'pip install "vn_nav[mesh]"'),
    'thor': Entry('vn_sim_bridge.simulators.thor',
                  'AI2-THOR, drawn by Unity', 'thor:FloorPlan227', ('ai2thor',),
                  'vn_nav simulators install thor', pip=THOR),
    'procthor': Entry('vn_sim_bridge.simulators.procthor',
                      'houses of ProcTHOR, with boxes where there are no meshes',
                      'procthor:house.json'),
    'dmlab': Entry('vn_sim_bridge.simulators.dmlab', 'DeepMind Lab: arena, mazes, a house, levels',
                   'dmlab:maze?seed=3', install='vn_nav simulators install dmlab',
                   setup='vn_sim_bridge.dmlab.install'),
    'grid': Entry('vn_sim_bridge.simulators.thor_grid',
                  'grids of pictures: dumps of AI2-THOR, and of other scenes',
                  'grid:bathroom_02?goals=26,37', ('h5py',), "pip install 'vn_nav[grid]'"),
    'gym': Entry('vn_sim_bridge.simulators.gymnasium_env',
                 'Gymnasium environments with pictures and discrete actions',
                 'gym:MiniWorld-Hallway-v0'),
    'suncg': Entry('vn_sim_bridge.simulators.suncg',
                   "houses in SUNCG's format, drawn by this package", 'suncg:HOUSE_ID?level=0',
                   ('PIL',), 'pip install "vn_nav[mesh]"'),
    'house3d': Entry('vn_sim_bridge.simulators.house3d',
                     "a user's own House3D (not tried against the real one)",
                     'house3d:HOUSE_ID', ('House3D',),
                     'build House3D and put its folder on PYTHONPATH; or use suncg:'),
}


def table() -> dict[str, Entry]:
    """The rows of this package, and those that entry points add."""
    found = dict(TABLE)
    for point in importlib.metadata.entry_points(group=GROUP):
        about = f'of the package {point.dist.name}' if point.dist else 'an entry point'
        found.setdefault(point.name, Entry(point.value, about, f'{point.name}:...'))
    return found


def missing(entry: Entry) -> list[str]:
    """What a simulator needs and this machine lacks."""
    lacking = [name for name in entry.needs if importlib.util.find_spec(name) is None]
    return lacking + (importlib.import_module(entry.setup).missing() if entry.setup else [])


def install(name: str, *, system: bool = False) -> str:
    """Install what a simulator needs; what was done, in a line.

    Args:
        name: of a row of the table.
        system: also Debian packages, as root.

    Raises:
        UserError: there is no such row, or something could not be installed.
    """
    entry = table().get(name)
    if entry is None or not (entry.pip or entry.setup):
        able = ', '.join(row for row, entry in table().items() if entry.pip or entry.setup)
        raise UserError(f'a simulator that is installed by this command is one of: {able}', name,
                        'choose one (vn_nav simulators)')
    if entry.setup:
        return importlib.import_module(entry.setup).install(system)
    for packages in entry.pip:
        command = [sys.executable, '-m', 'pip', 'install', '-qq', '--disable-pip-version-check',
                   *packages]
        if subprocess.run(command).returncode:
            raise UserError(f'pip installs {" ".join(packages)}', 'it failed, see above',
                            'correct it and try again')
    importlib.invalidate_caches()
    return f'{name}: {", ".join(" ".join(packages) for packages in entry.pip)}'


def simulator_class(name: str) -> type[BaseSimulator]:
    """The class of a simulator.

    Args:
        name: of a row, or of a module with a dot in it.

    Raises:
        UserError: there is none, or something is missing here.
    """
    known = table()
    if name in known:
        entry = known[name]
        if lacking := missing(entry):
            raise UserError(f'the simulator {name} needs {", ".join(lacking)}', 'not installed',
                            entry.install)
        module = entry.module
    elif '.' in name:
        module = name
    else:
        raise UserError(f'a simulator is one of: {", ".join(known)}, or a module such as '
                        'examples.corridor', name, 'choose one (vn_nav simulators)')
    try:
        return importlib.import_module(module).SIMULATOR
    except ModuleNotFoundError as error:
        raise UserError(f'the simulator {name} is a module that Python finds', str(error),
                        'install its package, or put its folder on PYTHONPATH') from error
    except AttributeError as error:
        raise UserError(f'the module {module} has a class SIMULATOR', str(error),
                        'name one on BaseSimulator so') from error


def robot_for(scenes: Sequence[str], robot: RobotSpec | None = None) -> RobotSpec:
    """A robot for some scenes, all of one simulator: the given one, or the scenes' own.

    Raises:
        UserError: scenes of several simulators, or one that there is not.
    """
    if robot is not None:
        return robot
    name, parsed = one_simulator(scenes)
    return simulator_class(name).own_robot(parsed, RobotSpec())


def open_simulator(scenes: Sequence[str], setup: Setup) -> Simulator:
    """The simulator of some scenes.

    Args:
        scenes: names, all of one simulator; see `vn_nav.scenes`.
        setup: robots, camera, pictures.

    Raises:
        UserError: scenes of several simulators, or one that there is not.
    """
    name, parsed = one_simulator(scenes)
    return simulator_class(name).open(parsed, setup)
