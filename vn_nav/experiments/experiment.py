"""An experiment as a file: what is compared, on what, for how long.

A YAML file in `config/experiments` (or a user's own) has these keys:

| key | what it holds |
|---|---|
| `title`, `question`, `claim` | texts of the page; `claim` is what the thesis found |
| `metric` | column of metrics.csv on the y axis |
| `reach` | values of the metric whose first lasting reach is in the table |
| `falls` | whether less of the metric is better (default: no) |
| `in_curriculum` | whether a value inside the curriculum counts (default: no) |
| `prepare` | commands that make files: `makes`, `command`, and `size` if only one needs it |
| `train`, `evaluate` | options of these commands, of every run |
| `arms` | what is compared: options of `vn_nav train`, by name |
| `sizes` | `quick` and `full`: further options of `vn_nav train`; `arms` in it: of some arms |

In texts of options and commands `{files}` is the folder of prepared files, `{share}` that of the
files which ship with the code, and `{name}`, for any option of the size, its value; in a command
of `prepare` the word `{scenes}` is `--scene` of all of them. Options are written as YAML:
`max_decisions: 900` is `--max-decisions 900`, a list is several values (of `scene`: several times
the option), `true` the option alone, and `set` a mapping of `--set NAME=VALUE`.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vn_nav.errors import UserError
from vn_nav.resources import share_file
from vn_nav.structured_file import read_yaml

FOLDER = 'config/experiments'
SIZES = ('quick', 'full')
REPEATED = ('scene',)  # options that are given once for each value
REMEDY = 'see vn_nav/experiments/experiment.py for what a file may hold'


@dataclasses.dataclass(frozen=True)
class Step:
    """A command of `vn_nav` that makes a file or folder, unless it is there."""

    makes: str
    command: str
    size: str | None = None  # the only one that needs it


@dataclasses.dataclass(frozen=True)
class Experiment:
    """What a file says; see the module."""

    name: str
    title: str
    question: str
    claim: str
    metric: str
    arms: Mapping[str, Mapping[str, Any]]
    sizes: Mapping[str, Mapping[str, Any]]
    reach: tuple[float, ...] = ()
    falls: bool = False
    in_curriculum: bool = False
    prepare: tuple[Step, ...] = ()
    train: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    evaluate: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def options(self, arm: str, size: str) -> dict[str, Any]:
        """The options of `vn_nav train` of an arm; what is said later counts."""
        sized = dict(self.sizes[size])
        parts = self.train, sized, self.arms[arm], sized.pop('arms', {}).get(arm, {})
        merged = {key: value for part in parts for key, value in part.items()}
        if sets := {key: value for part in parts for key, value in part.get('set', {}).items()}:
            merged['set'] = sets
        return merged


def experiment_names() -> list[str]:
    """The experiments that ship with the code."""
    return sorted(path.stem for path in share_file(FOLDER).glob('*.yaml'))


def load_experiment(name: str) -> Experiment:
    """An experiment by its name, or by the path of its file.

    Raises:
        UserError: there is none of that name; what its file lacks, or has too much.
    """
    path = Path(name) if name.endswith('.yaml') else None
    if path is None:
        if name not in experiment_names():
            raise UserError(f'an experiment is one of {", ".join(experiment_names())}, or a file '
                            'NAME.yaml', name, 'choose one')
        path = share_file(f'{FOLDER}/{name}.yaml')
    what = 'the file of an experiment'
    given = read_yaml(path, what, REMEDY)
    fields = {field.name: field for field in dataclasses.fields(Experiment)}
    needed = {name for name, field in fields.items() if name != 'name'
              and field.default is field.default_factory is dataclasses.MISSING}
    for wrong in (set(given) - set(fields) | set(given) & {'name'}, needed - set(given)):
        if wrong:
            raise UserError(f'{what} has the keys {", ".join(sorted(needed))} and may have '
                            f'{", ".join(sorted(set(fields) - needed - {"name"}))}',
                            f'{path}: {", ".join(sorted(wrong))}', REMEDY)
    _check(given, path)
    for size in given['sizes'].values():
        own = size.get('arms', {})
        if not isinstance(own, dict) or set(own) - set(given['arms']):
            raise UserError('arms of a size are options by name, of arms of the experiment',
                            f'{path}: {own!r}'[:200], REMEDY)
    steps = tuple(Step(**step) for step in given.pop('prepare', ()))
    return Experiment(name=path.stem, prepare=steps,
                      reach=tuple(map(float, given.pop('reach', ()))), **given)


def _check(given: dict[str, Any], path: Path) -> None:
    """Whether the parts of a file are of their kinds.

    Raises:
        UserError: the first one that is not.
    """
    def is_options(value) -> bool:
        return isinstance(value, dict) and all(isinstance(key, str) for key in value) and (
            isinstance(value.get('set', {}), dict))

    def are_options(value) -> bool:
        return isinstance(value, dict) and bool(value) and all(map(is_options, value.values()))

    def is_step(value) -> bool:
        return (isinstance(value, dict) and set(value) - {'size'} == {'makes', 'command'}
                and all(isinstance(text, str) for text in value.values())
                and value.get('size', SIZES[0]) in SIZES)

    def is_number(value) -> bool:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    rules = (
        ('title', 'a text', lambda value: isinstance(value, str)),
        ('question', 'a text', lambda value: isinstance(value, str)),
        ('claim', 'a text', lambda value: isinstance(value, str)),
        ('metric', 'a text', lambda value: isinstance(value, str)),
        ('falls', 'true or false', lambda value: isinstance(value, bool)),
        ('in_curriculum', 'true or false', lambda value: isinstance(value, bool)),
        ('reach', 'a list of numbers', lambda value: isinstance(value, list)
         and all(map(is_number, value))),
        ('train', 'options by name', is_options),
        ('evaluate', 'options by name', is_options),
        ('arms', 'options by name, by arm', are_options),
        ('sizes', f'options by name, of {" and ".join(SIZES)}',
         lambda value: are_options(value) and set(value) == set(SIZES)),
        ('prepare', 'a list of texts makes and command, and the size that alone needs it',
         lambda value: isinstance(value, list) and all(map(is_step, value))),
    )
    for key, kind, fits in rules:
        if key in given and not fits(given[key]):
            raise UserError(f'{key} of an experiment is {kind}', f'{path}: {given[key]!r}'[:200],
                            REMEDY)


def slug(text: str) -> str:
    """A name as part of a file's name: 'ICRA 2017' -> 'icra-2017'."""
    return re.sub(r'[^a-z0-9]+', '-', text.lower()).strip('-')


def arguments(options: Mapping[str, Any], values: Mapping[str, Any]) -> list[str]:
    """Options as a command line, with `{name}` replaced by values."""
    found: list[str] = []
    for name, value in options.items():
        option = '--' + name.replace('_', '-')
        if name == 'set':
            for key, part in value.items():
                found += ['--set', f'{key}={filled(part, values)}']
        elif isinstance(value, bool):
            found.append(option if value else option.replace('--', '--no-', 1))
        elif name in REPEATED and isinstance(value, list):
            for part in value:
                found += [option, filled(part, values)]
        elif isinstance(value, list):
            found += [option, *(filled(part, values) for part in value)]
        else:
            found += [option, filled(value, values)]
    return found


def filled(value: object, values: Mapping[str, Any]) -> str:
    """A value as text, with `{name}` replaced."""
    if isinstance(value, bool):
        return str(value).lower()
    text = str(value)
    for name, part in values.items():
        text = text.replace('{' + name + '}', str(part))
    return text
