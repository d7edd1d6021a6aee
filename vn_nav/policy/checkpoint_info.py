"""What a checkpoint says of itself, read without torch: the content of its `config.json`."""

from __future__ import annotations

import hashlib
import json
import math
import reprlib
from pathlib import Path
from typing import Any, NamedTuple

from vn_nav.errors import UserError
from vn_nav.scenes import HOUSE, house_scene
from vn_nav.structured_file import read_json

SEARCH = 'search'  # the architecture of `vn_nav.policy.search`
WEIGHTS, CONFIG, CARD = 'model.safetensors', 'config.json', 'README.md'
EXPORT = 'onnx'  # folder in that of a checkpoint: `vn_nav export`, unless it is told another
TRIAL = 'trial.json'  # in it, too: what `vn_nav drive-trial --keep` wrote
POLICY, GOAL, SEE, COMPARE = ONNX_FILES = 'policy.onnx', 'goal.onnx', 'see.onnx', 'compare.onnx'
PLACE = 'place.safetensors'  # of a policy that searches, where it was taught a place
FORMAT = 2
OWN = {'format', 'network', 'action_names', 'sha256'}  # keys that are not of INFO
PLACE_CHECKSUM = 'place_sha256'  # a key that is not of INFO either: of a taught policy alone
CHECKSUM = 'config_sha256'  # of everything else in the file; older checkpoints have none
DECODINGS = ('sample', 'greedy')
MOTION_NOISES = ('all', 'moves', 'none')  # of moves and turns, of moves alone, none
REQUIRED = object()
# What a checkpoint says besides its weights, and the defaults.
INFO: dict[str, Any] = {
    'world_version': REQUIRED,  # of the simulator's pixels, places and motion
    'camera_fov_deg': REQUIRED,  # of the square picture
    'camera_height': REQUIRED,  # m above the floor
    'decoding': 'sample',  # the rule that `results` were measured with
    'simulator': HOUSE,  # that it was trained in, see `vn_sim_bridge.simulators`
    'scenes': [],  # names, see `vn_nav.scenes`
    'task': 'image',  # what it was trained for
    'objects': 1,  # in a place at a time
    'randomisation': 'none',  # of light, camera and base: a name, or a file's path
    'preset': '',  # see vn_nav.learning.presets
    'motion_noise': 'all',  # of `MOTION_NOISES`
    'goals_per_room': 1,  # of each place
    'goal_variants': None,  # differently lit pictures of each goal; None: the randomisation's
    'stop_threshold': None,  # probability of arrival above which the policy declares its stop
    'seed': None,
    'frames': 0,  # agent decisions
    'minutes': 0.0,  # wall-clock of training
    'command': '',  # that trained it
    'label_names': [],  # of the classes that segmentation heads draw; empty: nobody knows
    'data': '',  # recorded pictures that it learned from, a text; empty: it learned by driving
    'losses': [],  # what `vn_nav pretrain` learned; no episode was driven
    'results': {},  # measured figures and controls, by name
    'notes': '',
}


class Rule(NamedTuple):
    """What a value has to be."""

    types: tuple[type, ...]
    least: float = -math.inf  # of a number
    most: float = math.inf


TEXT, LIST, INTEGER, NUMBER = (str,), (list, tuple), (int,), (int, float)
# None is allowed where it is the default.
INFO_TYPES = {
    'world_version': Rule(TEXT), 'decoding': Rule(TEXT), 'task': Rule(TEXT),
    'randomisation': Rule(TEXT), 'preset': Rule(TEXT), 'command': Rule(TEXT),
    'motion_noise': Rule(TEXT), 'notes': Rule(TEXT), 'results': Rule((dict,)),
    'label_names': Rule(LIST),
    'data': Rule(TEXT), 'losses': Rule(LIST),
    'scenes': Rule(LIST), 'simulator': Rule(TEXT), 'objects': Rule(INTEGER, 0, 1000),
    'goals_per_room': Rule(INTEGER, 1, 1000), 'goal_variants': Rule(INTEGER, 1, 1000),
    'stop_threshold': Rule(NUMBER, 0, 1), 'seed': Rule(INTEGER, -2**63, 2**64),
    'frames': Rule(INTEGER, 0, 2**63), 'minutes': Rule(NUMBER, 0, 1e9),
    'camera_fov_deg': Rule(NUMBER, 1e-3, 179), 'camera_height': Rule(NUMBER, 1e-3, 100),
}


def read_config(folder: str | Path, beside: tuple[str, ...] = (WEIGHTS, *ONNX_FILES)
                ) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read and check `config.json`; the network and the weights are not looked at.

    Args:
        folder: of the checkpoint, or of its export.
        beside: other files, one of which has to be there.

    Returns:
        All of it, and of it the keys of `INFO`.

    Raises:
        UserError: a missing or corrupt file, another format, missing or unknown keys, or values
            of a wrong type or size.
    """
    folder = Path(folder)
    for names in ((CONFIG,), beside):
        if not any((folder / name).is_file() for name in names):
            raise UserError(f'a checkpoint is a folder with {CONFIG} and {beside[0]}',
                            str(folder / names[0]),
                            'pass such a folder; shipped ones are in models/')
    where = str(folder / CONFIG)
    config = read_json(where, CONFIG, 'get the checkpoint again')
    if config.get('format') != FORMAT:
        raise UserError(f'{CONFIG} has format {FORMAT}', reprlib.repr(config.get('format')),
                        'use the version of vn_nav that wrote it, or train again')
    if missing := OWN - config.keys():
        raise UserError(f'{CONFIG} has the keys {", ".join(sorted(OWN))}',
                        f'{where} without {", ".join(sorted(missing))}',
                        'get the checkpoint again')
    if CHECKSUM in config and config.pop(CHECKSUM) != config_checksum(config):
        raise UserError(f'{CONFIG} is as it was written ({CHECKSUM} is the SHA-256 of the rest)',
                        where, 'the file is corrupt: get the checkpoint again; after a change of '
                        f'your own remove {CHECKSUM}')
    info = {key: value for key, value in config.items()
            if key not in OWN and key != PLACE_CHECKSUM}
    return config, check_info(info, where)


def config_checksum(config: dict) -> str:
    """SHA-256 of what a configuration says, however its file is laid out."""
    text = json.dumps(config, sort_keys=True, separators=(',', ':'), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def check_info(info: dict, where: str) -> dict:
    """The keys of `INFO` with their defaults.

    Args:
        info: some of them.
        where: they stand, for people.

    Raises:
        UserError: a missing or unknown key, or a value of a wrong type or size.
    """
    info = _named_scenes(info, where)
    unknown = sorted(info.keys() - INFO.keys())
    if unknown:
        raise UserError(f'{CONFIG} has only the keys {", ".join(INFO)} in addition to the network',
                        f'{unknown[0]} in {where}', 'remove it, or use the version of vn_nav '
                        'that wrote it')
    full = {key: info.get(key, default) for key, default in INFO.items()}
    missing = [key for key, value in full.items() if value is REQUIRED]
    if missing:
        raise UserError(f'{CONFIG} has the key {missing[0]}', f'{where} without it', 'add it')
    for key, value in full.items():
        if value is not None or INFO[key] is not None:
            _check_entry(key, value, where)
    for key, values in (('decoding', DECODINGS), ('motion_noise', MOTION_NOISES)):
        if full[key] not in values:
            raise UserError(f'{key} is {" or ".join(values)}', full[key], f'correct {where}')
    return full


def _named_scenes(info: dict, where: str) -> dict:
    """The same, with names in place of the seeds of houses that earlier versions wrote."""
    if 'houses' not in info:
        return {key: value for key, value in info.items() if key != 'rooms'}
    houses, rooms = info['houses'], info.get('rooms')
    numbers = [*houses, rooms or 1] if isinstance(houses, (list, tuple)) else [None]
    if not all(type(number) is int and 0 <= number < 2**63 for number in numbers):
        raise UserError('houses is a list of seeds, and rooms their number', reprlib.repr(
            (houses, rooms)), f'correct {where}')
    return {**{key: value for key, value in info.items() if key not in ('houses', 'rooms')},
            'scenes': [house_scene(seed, rooms) for seed in houses]}


def _check_entry(key: str, value: object, where: str) -> None:
    """Raise a `UserError` for a value of another type than its key's, or out of its range."""
    rule = INFO_TYPES[key]
    kept = isinstance(value, rule.types) and not isinstance(value, bool)
    if kept and isinstance(value, LIST):
        kept = all(isinstance(one, str) for one in value)
    if not kept:
        names = ' or '.join(kind.__name__ for kind in rule.types)
        raise UserError(f'{key} is {names}', reprlib.repr(value), f'correct {where}')
    if isinstance(value, NUMBER) and not rule.least <= value <= rule.most:
        raise UserError(f'{key} lies between {rule.least:g} and {rule.most:g}', value,
                        f'correct {where}')
