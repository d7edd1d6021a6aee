"""Scenes by name: `house:7`, `house:7?rooms=3`, `bag:my_drive`.

`SIMULATOR:PLACE?OPTION=VALUE&...`. The simulator is one that `vn_nav simulators` lists, or a
module (`examples.corridor:8`); what its places and options are is its own affair. Names stand in
configurations, checkpoints, figures and parameters; two names of one scene are never different.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from vn_nav.errors import UserError

HOUSE, BAG = 'house', 'bag'  # the simulators that other parts know by name
ROOMS = 5  # of a house that is named without them
EXAMPLE = 'name it as in house:7, house:7?rooms=3 or bag:my_drive'
# What options mean where a name leaves them out, by simulator or by its place ('*/*': places with
# a slash). A simulator whose defaults stand here has one name for a scene, with them or without.
DEFAULTS: Mapping[str, Mapping[str, str]] = {
    HOUSE: {'rooms': str(ROOMS)},
    'dmlab:arena': {'apples': '8', 'lemons': '8', 'decisions': '300'},
    'dmlab:maze': {'seed': '0', 'size': '7'},
    'dmlab:*/*': {'seed': '0'},
    'gltf': {'doors': 'as_drawn', 'height': '1.2', 'scale': '1', 'up': 'y'},
    'grid': {'distances': 'file'},
    'house3d': {'device': '0', 'labels': 'coarse'},
    'procthor': {'doors': 'open'},
    'suncg': {'depth': 'metres', 'labels': 'nyu40', 'level': '0', 'obstacles': 'mesh',
              'targets': 'house3d'},
    'thor': {'moves': 'bisect', 'objects': 'still'},
}
# Options that are whole numbers there: 03 is 3. (Names of places and files are left as they are.)
NUMBERS = {'apples', 'decisions', 'device', 'index', 'lemons', 'level', 'rooms', 'seed', 'size',
           'storey'}
_SIMULATOR = re.compile(r'[A-Za-z_]\w*(\.[A-Za-z_]\w*)*')
_OPTION = re.compile(r'([a-z_]+)=([^&=?]+)')


class SceneName(NamedTuple):
    """A scene's name in its parts; `str` puts them together again."""

    simulator: str
    place: str
    options: tuple[tuple[str, str], ...] = ()  # sorted

    def __str__(self) -> str:
        options = '&'.join(f'{key}={value}' for key, value in self.options)
        return f'{self.simulator}:{self.place}' + (f'?{options}' if options else '')


def parse_scene(text: str) -> SceneName:
    """The parts of a scene's name.

    Raises:
        UserError: it is none.
    """
    rule = 'a scene is SIMULATOR:PLACE, or SIMULATOR:PLACE?OPTION=VALUE&...'
    if not isinstance(text, str):
        raise UserError(rule, text, EXAMPLE)
    simulator, colon, rest = text.partition(':')
    place, question, options = rest.partition('?')
    if not (colon and place and _SIMULATOR.fullmatch(simulator)):
        raise UserError(rule, text, EXAMPLE)
    pairs: list[tuple[str, str]] = []
    for part in options.split('&') if question else ():
        found = _OPTION.fullmatch(part)
        if not found or found[1] in dict(pairs):
            raise UserError(rule, text, EXAMPLE)
        pairs.append((found[1], found[2]))
    # Two names of one scene are never different.
    if simulator == HOUSE:
        place = _plain(place)
    if simulator in {name.partition(':')[0] for name in DEFAULTS}:
        defaults = defaults_of(simulator, place)
        pairs = [(key, _plain(value) if key in NUMBERS else value) for key, value in pairs
                 if not _same(value, defaults.get(key))]
    return SceneName(simulator, place, tuple(sorted(pairs)))


def defaults_of(simulator: str, place: str) -> Mapping[str, str]:
    """What the options of a place mean where its name leaves them out; see `DEFAULTS`."""
    for name in (f'{simulator}:{place}', f'{simulator}:*/*' if '/' in place else '', simulator):
        if name in DEFAULTS:
            return DEFAULTS[name]
    return {}


def _plain(number: str) -> str:
    """A whole number without leading zeros; other text as it is."""
    return str(int(number)) if re.fullmatch(r'\d{1,18}', number) else number


def _same(value: str, default: str | None) -> bool:
    """Whether a value is the default, as text or as a number."""
    if value == default or default is None:
        return value == default
    decimal = r'\d{1,18}(\.\d{1,18})?'
    return bool(re.fullmatch(decimal, value) and re.fullmatch(decimal, default)
                and float(value) == float(default))


def scene_name(text: str) -> str:
    """A scene's name as it is written everywhere.

    Raises:
        UserError: it is none.
    """
    return str(parse_scene(text))


def house_scene(seed: int, rooms: int | None = None) -> str:
    """The scene of an embedded house, by the seed and the number of rooms."""
    options = () if rooms in (None, ROOMS) else (('rooms', str(int(rooms))),)
    return str(SceneName(HOUSE, str(int(seed)), options))


def house_scenes(seeds: Iterable[int], rooms: int | None = None) -> tuple[str, ...]:
    """The scenes of some embedded houses, see `house_scene`."""
    return tuple(house_scene(seed, rooms) for seed in seeds)


def one_simulator(scenes: Iterable[str]) -> tuple[str, list[SceneName]]:
    """The simulator that some scenes belong to, and their names in parts.

    Raises:
        UserError: no scene, or scenes of several simulators.
    """
    parsed = [parse_scene(scene) for scene in scenes]
    names = {scene.simulator for scene in parsed}
    if len(names) != 1:
        raise UserError('there is at least one scene, and all are of one simulator',
                        ', '.join(map(str, parsed)) or 'none', EXAMPLE)
    return names.pop(), parsed


def options_of(scene: SceneName, known: Sequence[str]) -> dict[str, str]:
    """The options of a scene, by name.

    Raises:
        UserError: one that its simulator does not know.
    """
    given = dict(scene.options)
    if unknown := sorted(given.keys() - set(known)):
        raise UserError(f'options of a scene of {scene.simulator} are: '
                        f'{", ".join(known) or "none"}', f'{unknown[0]} in {scene}',
                        'leave it out')
    return given


def rooms_of(scene: str) -> int:
    """The number of rooms of an embedded house."""
    return int(dict(parse_scene(scene).options).get('rooms', ROOMS))


def whole_number(scene: SceneName, name: str, value: str) -> int:
    """The number that a part of a scene's name is.

    Raises:
        UserError: it is none.
    """
    if not re.fullmatch(r'\d{1,18}', value):
        raise UserError(f'the {name} of a scene of {scene.simulator} is a whole number',
                        str(scene), EXAMPLE)
    return int(value)
