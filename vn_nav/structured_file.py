"""Small YAML and JSON files that somebody wrote by hand or that may be damaged, read strictly.

A file is UTF-8 and of bounded size, and names each key once: of two values neither is guessed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import yaml

from vn_nav.errors import UserError

MAX_BYTES = 4_000_000  # of a file; the largest shipped one has 40 kB


def read_yaml(path: str | Path, what: str, remedy: str) -> dict[str, Any]:
    """Read a mapping from YAML.

    Args:
        path: of the file.
        what: names the file in errors, as in 'a robot file'.
        remedy: what to do instead.

    Raises:
        UserError: no such file, or one that is too large, not UTF-8, not YAML, no mapping with
            text as keys, or that has a key twice.
    """
    return _read(path, what, 'YAML', remedy, lambda text: yaml.load(text, _StrictLoader))


def read_json(path: str | Path, what: str, remedy: str) -> dict[str, Any]:
    """Read a mapping from JSON, without NaN and infinities; arguments and errors as above."""
    def parse(text: str) -> object:
        return json.loads(text, object_pairs_hook=_once, parse_constant=_refuse)
    return _read(path, what, 'JSON', remedy, parse)


def _read(path: str | Path, what: str, kind: str, remedy: str,
          parse: Callable[[str], object]) -> dict[str, Any]:
    path = Path(path)
    if not path.is_file():
        raise UserError(f'{what} exists', str(path), remedy)
    try:
        with path.open('rb') as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise UserError(f'{what} has at most {MAX_BYTES // 1_000_000} MB', str(path), remedy)
        found = parse(data.decode())
    except (OSError, ValueError, TypeError, OverflowError, RecursionError,
            yaml.YAMLError) as error:
        said = ' '.join(str(error).split())[:300] or type(error).__name__
        raise UserError(f'{what} is {kind} in UTF-8', f'{path}: {said}', remedy) from error
    if not isinstance(found, dict) or not all(isinstance(key, str) for key in found):
        raise UserError(f'{what} is a {kind} mapping of names to values',
                        f'{path}: {type(found).__name__}', remedy)
    return found


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [key for key, _ in pairs]
        raise ValueError(f'the key {next(key for key in names if names.count(key) > 1)} twice')
    return found


def _refuse(text: str) -> None:
    raise ValueError(f'{text} is no number of JSON')


class _StrictLoader(yaml.SafeLoader):
    """The safe loader, which refuses a key that stands twice."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f'the key {key} twice', key_node.start_mark)
            if isinstance(key, Hashable):
                seen.add(key)
        return super().construct_mapping(node, deep)
