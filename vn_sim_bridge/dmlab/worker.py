"""One engine of DeepMind Lab in a process of its own; it speaks JSON lines, and draws into memory.

It runs in the engine's virtual environment: NumPy and the engine, nothing of this package.
Arguments: the number of an open file that holds pictures [rows, size, size, 4] uint8 (RGB, depth),
and the size.

Requests are lines {"do": NAME, ...} on standard input, answers lines on standard output::

    open    level, folder (of levels), cache (folder of compiled maps), settings, width
    reset   seed: the pose [x, y, z, yaw] where the level puts the player
    go      poses [[x, y, z, yaw], ...], rows (of the file), act (a decision): reward, ended
    free    ways [[x, y, z, heading, length], ...]: how far each is free

Lengths are units of the engine, angles degrees. An error is {"error": TEXT}.
"""

import importlib.machinery
import importlib.util
import json
import mmap
import os
import signal
import sys
from typing import Any

import numpy as np

OWN = 7  # actions of the engine itself; ours follow
GO, ACT, RAY = 1, 2, 3  # see `levels/vn_nav.lua`
REST = 24  # frames after which a player that was put somewhere stands still
NEAR = 0.05  # units
LIFT = 1.0  # units that the engine lifts a player that it puts somewhere


def load_engine():
    """The module of the engine: a genuine `deepmind_lab`, or that of dmhouse."""
    for name in ('deepmind_lab', 'dmhouse'):
        spec = importlib.util.find_spec(name)
        if spec is None or spec.origin is None:
            continue
        folder = os.path.dirname(spec.origin)
        library = os.path.join(folder, 'deepmind_lab.so')
        if name == 'deepmind_lab' or not os.path.exists(library):
            return importlib.import_module(name), folder
        # The package's own __init__ asks for a Gym of long ago.
        loader = importlib.machinery.ExtensionFileLoader(name, library)
        own = importlib.util.spec_from_loader(name, loader)
        assert own is not None  # there is a loader
        module = importlib.util.module_from_spec(own)
        sys.modules[name] = module
        loader.exec_module(module)
        module.set_runfiles_path(folder)
        return module, folder
    raise ImportError('neither deepmind_lab nor dmhouse is installed for ' + sys.executable)


def link_map(file, folder):
    """Let the engine find a compiled map of the user's."""
    target = os.path.join(folder, os.path.basename(file))
    if os.path.islink(target) and os.readlink(target) != file:
        os.remove(target)
    if not os.path.exists(target):
        os.symlink(file, target)


class Cache:
    """Compiled maps in a folder: a map is compiled once, for all engines and all runs."""

    def __init__(self, folder):
        self.folder = folder

    def fetch(self, key, path):
        """Copy a compiled map to `path`; False: there is none yet."""
        try:
            with open(os.path.join(self.folder, key), 'rb') as source:
                content = source.read()
        except OSError:
            return False
        with open(path, 'wb') as target:
            target.write(content)
        return True

    def write(self, key, path):
        """Keep a compiled map; whole or not at all."""
        os.makedirs(self.folder, exist_ok=True)
        own = os.path.join(self.folder, f'{key}.{os.getpid()}')
        with open(path, 'rb') as source, open(own, 'wb') as target:
            target.write(source.read())
        os.replace(own, os.path.join(self.folder, key))


class Worker:
    """One engine and the memory that it draws into."""

    def __init__(self, memory):
        self.memory, self.push, self.native = memory, None, False
        self.lab: Any = None  # of the engine's module

    def open(self, level, folder, cache, settings, width):
        """Start the engine with a level; in place of the one that it plays."""
        module, runfiles = load_engine()
        if self.lab is not None:
            self.lab.close()
        self.push, self.native = None, 'map' not in settings
        if 'bsp_file' in settings:
            link_map(settings.pop('bsp_file'), os.path.join(runfiles, 'baselab', 'maps'))
        config = dict(settings, width=str(width), height=str(width), fps='50',
                      levelDirectory=folder)
        if module.__name__ == 'dmhouse':  # its apple.md3 is a piece of furniture
            config['apple'] = 'models/apple_backup.md3'
        self.lab = module.Lab(level, ['RGBD_INTERLEAVED', 'VN_POSE'], config,
                              renderer='software', level_cache=Cache(cache))
        self.count = len(self.lab.action_spec())
        return {'engine': module.__name__}

    def reset(self, seed):
        """Begin an episode: where the level puts the player."""
        self.lab.reset(seed=seed)
        if self.native:
            self._act(frames=REST)  # it falls on the floor
        pose = self._pose()
        if self.push is None:
            # How far a player that is put somewhere glides: the same everywhere, whatever it did.
            self._act(GO, frames=REST)
            self.push = self._pose()[0]
            if self.native:
                self.lab.reset(seed=seed)
                self._act(frames=REST)
                pose = self._pose()
        return {'pose': pose}

    def _pose(self):
        return self.lab.observations()['VN_POSE'][:4].tolist()

    def _act(self, do=0, x=0.0, y=0.0, z=0.0, yaw=0.0, length=0.0, frames=1):
        action = np.zeros(self.count, np.intc)
        action[OWN:OWN + 6] = do, *(round(1000 * part) for part in (x, y, z, yaw, length))
        reward = self.lab.step(action, num_steps=1)
        if frames > 1 and self.lab.is_running():
            reward += self.lab.step(np.zeros(self.count, np.intc), num_steps=frames - 1)
        return reward

    def go(self, poses, rows, act=False):
        """Pictures from poses, into rows of the memory. None of an episode that has ended."""
        total = 0.0
        for (x, y, z, yaw), row in zip(poses, rows, strict=True):
            turn = np.radians(yaw)
            total += self._act(ACT if act else GO, x - self.push * np.cos(turn),
                               y - self.push * np.sin(turn), z - LIFT, yaw, self.push, REST)
            if not self.lab.is_running():
                return {'reward': total, 'ended': True}
            seen = self.lab.observations()
            wrong = np.abs(seen['VN_POSE'][:3] - (x, y, z)).max()
            if wrong > NEAR:
                raise ValueError(f'the player stands {wrong:.3f} units beside its place')
            self.memory[row] = seen['RGBD_INTERLEAVED']
        return {'reward': total, 'ended': False}

    def free(self, ways):
        """How far ways are free."""
        found = []
        for way in ways:
            self._act(RAY, *way)
            found.append(float(self.lab.observations()['VN_POSE'][4]))
        return {'free': found}


def main():
    """Answer requests until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started it ends it
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # the engine writes to standard output as it likes
    descriptor, width = int(sys.argv[1]), int(sys.argv[2])
    memory = np.frombuffer(mmap.mmap(descriptor, 0), np.uint8).reshape(-1, width, width, 4)
    worker = Worker(memory)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = getattr(worker, request.pop('do'))(**request)
        except Exception as error:  # whatever the engine says: told in one line
            answer = {'error': f'{type(error).__name__}: {error}'.splitlines()[0]}
        answers.write(json.dumps(answer) + '\n')
        answers.flush()


if __name__ == '__main__':
    main()
