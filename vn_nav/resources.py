"""Finds the files that ship with the code: models, robots, presets, middleware profiles."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from vn_nav.errors import UserError

PACKAGE = 'vn_nav'


def share_folders() -> list[Path]:
    """The folders that may hold shipped files, the best first.

    The code's own files come before those of any other installation: a checkpoint of another
    version must not be picked up because that version's set-up happened to be sourced last.
    """
    code = Path(__file__).resolve().parent
    folders = [code.parent] if (code.parent / 'package.xml').is_file() else []  # a source tree
    prefixes = [*code.parents, Path(sys.prefix)]
    prefixes += [Path(entry) for entry in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
                 if entry]
    return folders + [prefix / 'share' / PACKAGE for prefix in prefixes]


def share_file(relative: str | Path) -> Path:
    """The absolute path of a shipped file or folder, such as 'config/robots/standard.yaml'.

    Raises:
        UserError: neither a source tree nor an installation has it.
    """
    for folder in share_folders():
        if (folder / relative).exists():
            return folder / relative
    raise UserError(f'a shipped file lies in the source tree or in share/{PACKAGE}', str(relative),
                    'correct the name, or install the package again')
