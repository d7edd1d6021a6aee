"""The cache of decoded bags: read at memory speed, made whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vn_nav.bags.dataset import DriveSet, Wanted
from vn_nav.bags.drive_decoder import FORMAT, INDEX, decode_bag
from vn_nav.bags.storage.bag_files import files_of
from vn_nav.errors import UserError


def load_drives(bag: str | Path, wanted: Wanted, cache: str | Path,
                show: Callable[[float], None] = lambda share: None) -> DriveSet:
    """The steps of a bag, decoded now or from the cache.

    Args:
        bag: a rosbag2 folder or an MCAP file.
        wanted: what to make of it.
        cache: folder of decoded bags. An entry is made whole or not at all, and belongs to the
            files as they are now: a bag that changes is decoded anew.
        show: receives the share of the pictures that is decoded.

    Raises:
        UserError: no readable bag, topics that it lacks, a camera narrower than the robot's, no
            usable picture, or a full disk.
    """
    bag = Path(bag)
    folder = Path(cache) / _key(bag, wanted)
    if not (folder / INDEX).is_file():
        temporary = folder.with_name(f'.{folder.name}.{os.getpid()}.tmp')
        shutil.rmtree(temporary, ignore_errors=True)
        try:
            temporary.mkdir(parents=True)
            decode_bag(bag, wanted, temporary, show)
            if folder.exists():  # another process was faster, or a broken entry
                shutil.rmtree(folder)
            temporary.rename(folder)
        except OSError as error:
            raise UserError('decoded bags are kept in the cache',
                            f'{error.filename or folder}: {error.strerror}',
                            'free some space, or choose another --cache') from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return _open(folder)


def _open(folder: Path) -> DriveSet:
    index = json.loads((folder / INDEX).read_text())
    columns = {name: np.memmap(folder / f'{name}.bin', layout['dtype'], 'r',
                               shape=tuple(layout['shape']))
               for name, layout in index['columns'].items()}
    rows = np.load(folder / 'rows.npy')
    size = columns['image'].shape[-1]
    kept = columns['beside']
    return DriveSet(
        image=columns['image'], pose=rows[:, 4:], time=rows[:, 0],
        action=rows[:, 1].astype(np.int16), episode=rows[:, 2].astype(np.int64),
        goal=rows[:, 3].astype(np.int64),
        goals=columns.get('goals', np.zeros((0, 3, size, size), np.uint8)),
        # Only what every step has can be learned from in batches.
        depth=columns['depth'] if kept[:, 0].all() else None,
        labels=columns['labels'] if kept[:, 1].all() else None, facts=index['facts'])


def _key(bag: Path, wanted: Wanted) -> str:
    """Of a bag as it is now, and of what to make of it.

    Raises:
        BagError: no bag, or one that cannot be read whole.
    """
    files = files_of(bag).paths
    digest = hashlib.sha256(repr((
        FORMAT, [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files],
        str(bag.resolve()), wanted.robot.moves, wanted.robot.camera_fov, wanted.size,
        wanted.topics, wanted.every)).encode())
    return digest.hexdigest()[:24]
