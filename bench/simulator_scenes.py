"""A scene of every simulator, made here: files of embedded houses, and a peer in Unity's place."""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
from pathlib import Path

from vn_nav.cli.commands import main as vn_nav
from vn_nav.errors import UserError

ROOT = Path(__file__).resolve().parent.parent
TESTS = ROOT / 'test'
SCENES = ('house', 'dmlab_arena', 'dmlab_maze', 'dmlab_house', 'thor', 'grid', 'suncg', 'gltf',
          'procthor', 'miniworld', 'vizdoom')


def scene(name: str, folder: Path) -> str:
    """The scene of one of `SCENES`; what it needs is written into a folder once.

    Sets VN_NAV_THOR_BUILD (unless it is set) and SUNCG_PATH for this process and its children.
    """
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if name == 'grid':
        return f'grid:{_made(folder / "house7.h5", "simulators", "dump", "house:7", "--size", 84)}'
    if name == 'suncg':
        os.environ['SUNCG_PATH'] = str(folder / 'suncg')
        if not (folder / 'suncg/house/house_7/house.json').exists():
            _run('house', 'export', '--seed', 7, '--suncg', folder / 'suncg')
        return 'suncg:house_7?labels=coarse'
    if name == 'gltf':
        return f'gltf:{_made(folder / "house7.glb", "house", "export", "--seed", 7)}'
    if name == 'procthor':
        sys.path.insert(0, str(TESTS))
        from procthor_houses import small_house
        path = folder / 'procthor.json'
        path.write_text(json.dumps(small_house()))
        return f'procthor:{path}'
    if name == 'thor':
        use_peer(folder)
    return {'house': 'house:7', 'dmlab_arena': 'dmlab:arena', 'dmlab_maze': 'dmlab:maze?seed=3',
            'dmlab_house': 'dmlab:house', 'thor': 'thor:FloorPlan227',
            'miniworld': 'gym:MiniWorld-FourRooms-v0', 'vizdoom': 'gym:VizdoomMyWayHome-v1'}[name]


def use_peer(folder: Path) -> None:
    """Let the AI2-THOR client run the tests' peer; a build that the user names stays."""
    from vn_sim_bridge.thor.client import BUILD
    if BUILD not in os.environ:
        path = folder / 'unity'
        path.write_text(f'#!/bin/sh\nexec {sys.executable} {TESTS}/simulators/thor_peer.py "$@"\n')
        path.chmod(0o755)
        os.environ[BUILD] = str(path)


def _made(path: Path, *command) -> Path:
    """A file that a command writes, unless it is there."""
    if not path.exists():
        unfinished = path.with_stem(path.stem + '-unfinished')
        _run(*command, '--out', unfinished)
        unfinished.replace(path)
    return path


def _run(*command) -> None:
    """A command of vn_nav, quietly."""
    with contextlib.redirect_stdout(io.StringIO()):
        if vn_nav([str(part) for part in command]):
            raise UserError('vn_nav made the scene', ' '.join(map(str, command)), 'see above')
