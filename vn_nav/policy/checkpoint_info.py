"""What a checkpoint says of itself, read without torch: the content of its `config.json`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from vn_nav.errors import UserError

WEIGHTS, CONFIG, CARD = 'model.safetensors', 'config.json', 'README.md'
FORMAT = 2
DECODINGS = ('sample', 'greedy')
REQUIRED = object()
# What a checkpoint says beside its weights, and what it says when nobody told it.
INFO = {
    'world_version': REQUIRED,  # of the simulator's pixels, houses and motion
    'camera_fov_deg': REQUIRED,  # of the square picture
    'camera_height': REQUIRED,  # m above the floor
    'decoding': 'sample',  # the rule that `results` were measured with
    'houses': [],  # seeds
    'rooms': None,  # of each house
    'task': 'image',  # what it was trained for
    'objects': 1,  # in the house at a time
    'randomisation': 'none',  # of light, camera and base: a name, or a file's path
    'preset': '',  # see vn_nav.learning.presets
    'goals_per_room': 1,  # of each house
    'goal_variants': None,  # differently lit pictures of each goal; None: the randomisation's
    'stop_threshold': None,  # probability of arrival above which the policy declares its stop
    'seed': None,
    'frames': 0,  # agent decisions
    'minutes': 0.0,  # wall-clock of training
    'command': '',  # that trained it
    'results': {},  # measured figures and controls, by name
    'notes': '',
}


def read_config(folder: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read and check `config.json`; the weights are not looked at.

    Returns:
        All of it, and of it the keys of `INFO`.

    Raises:
        UserError: a missing file, another format, or missing or unknown keys.
    """
    folder = Path(folder)
    for name in (CONFIG, WEIGHTS):
        if not (folder / name).is_file():
            raise UserError(f'a checkpoint is a folder with {CONFIG} and {WEIGHTS}',
                            str(folder / name), 'pass such a folder; shipped ones are in models/')
    try:
        config = json.loads((folder / CONFIG).read_text())
    except ValueError as error:
        raise UserError(f'{CONFIG} is JSON', f'{folder / CONFIG}: {error}',
                        'get the checkpoint again') from error
    if not isinstance(config, dict) or config.get('format') != FORMAT:
        received = config.get('format') if isinstance(config, dict) else type(config).__name__
        raise UserError(f'{CONFIG} has format {FORMAT}', received,
                        'use the version of vn_nav that wrote it, or train again')
    where = str(folder / CONFIG)
    own = {'format', 'network', 'action_names', 'sha256'}
    missing = own - config.keys()
    if missing:
        raise UserError(f'{CONFIG} has the keys {", ".join(sorted(own))}',
                        f'{where} without {", ".join(sorted(missing))}',
                        'get the checkpoint again')
    info = {key: value for key, value in config.items() if key not in own}
    return config, check_info(info, where)


def check_info(info: dict, where: str) -> dict:
    """The keys of `INFO` with their defaults.

    Args:
        info: some of them.
        where: they stand, for people.

    Raises:
        UserError: a missing or unknown key, or a value that is none.
    """
    unknown = sorted(info.keys() - INFO.keys())
    if unknown:
        raise UserError(f'{CONFIG} has only the keys {", ".join(INFO)} beside the network',
                        f'{unknown[0]} in {where}', 'remove it, or use the version of vn_nav '
                        'that wrote it')
    full = {key: info.get(key, default) for key, default in INFO.items()}
    missing = [key for key, value in full.items() if value is REQUIRED]
    if missing:
        raise UserError(f'{CONFIG} has the key {missing[0]}', f'{where} without it', 'add it')
    if full['decoding'] not in DECODINGS:
        raise UserError('decoding is sample or greedy', full['decoding'], f'correct {where}')
    for key, limit in (('camera_fov_deg', 179.0), ('camera_height', 100.0)):
        value = full[key]
        if not (isinstance(value, (int, float)) and math.isfinite(value) and 0 < value <= limit):
            raise UserError(f'{key} lies in (0, {limit:g}]', value, f'correct {where}')
    return full
