"""Where the engine of DeepMind Lab is, and how it gets there."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from pathlib import Path

from vn_nav.errors import UserError

# The thesis author's build of DeepMind Lab, and a NumPy that it works with.
PACKAGES = (('--no-deps', 'dmhouse==1.0.10'), ('numpy==1.26.4',))
LIBRARIES = {'libSDL2-2.0.so.0': 'libsdl2-2.0-0', 'libOSMesa.so.8': 'libosmesa6'}  # of Debian
PYTHON, HOME, MAPS = 'VN_NAV_DMLAB_PYTHON', 'VN_NAV_DMLAB', 'VN_NAV_DMLAB_MAPS'
REMEDY = 'vn_nav simulators install dmlab'


def folder() -> Path:
    """The engine's virtual environment: `$VN_NAV_DMLAB`, or below `$XDG_DATA_HOME`."""
    data = os.environ.get('XDG_DATA_HOME') or Path.home() / '.local' / 'share'
    return Path(os.environ.get(HOME) or Path(data) / 'vn_nav' / 'dmlab').absolute()


def cache_folder() -> Path:
    """Where compiled maps are kept."""
    cache = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
    return Path(cache).absolute() / 'vn_nav' / 'dmlab_maps'


def interpreter() -> Path:
    """The Python that has the engine: `$VN_NAV_DMLAB_PYTHON` (a genuine deepmind_lab), or ours.

    Raises:
        UserError: there is none, or a Debian package is missing.
    """
    given = os.environ.get(PYTHON)
    if given:
        if not os.access(given, os.X_OK):
            raise UserError(f'{PYTHON} is a Python that has deepmind_lab', given,
                            'correct it, or leave it out')
        return Path(given).absolute()
    if not _is_made():
        raise UserError('the simulator dmlab has its engine in an environment of its own',
                        f'none in {folder()}', REMEDY)
    if lacking := missing_packages():
        raise UserError('the engine of DeepMind Lab needs Debian packages',
                        f'without {", ".join(lacking)}', f'apt install {" ".join(lacking)}')
    return folder() / 'bin' / 'python'


def missing_packages() -> list[str]:
    """Debian packages whose libraries this machine lacks."""
    lacking = []
    for library, package in LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            lacking.append(package)
    return lacking


def missing() -> list[str]:
    """What is missing here, in words; a Python that was named is looked at when it is used."""
    if os.environ.get(PYTHON):
        return []
    engine = [] if _is_made() else [f'its engine (none in {folder()})']
    return engine + missing_packages()


def _is_made() -> bool:
    return (folder() / 'installed').exists() and (folder() / 'bin' / 'python').exists()


def install(system: bool) -> str:
    """Make the engine's environment; what was done, in a line.

    Args:
        system: also install the Debian packages, as root.

    Raises:
        UserError: something could not be installed.
    """
    target = folder()
    done = target / 'installed'
    wanted = '\n'.join(' '.join(row) for row in PACKAGES)
    if not (done.exists() and done.read_text() == wanted and (target / 'bin/python').exists()):
        _run([sys.executable, '-m', 'venv', '--clear', str(target)])
        for row in PACKAGES:
            _run([str(target / 'bin' / 'python'), '-m', 'pip', 'install', '-qq',
                  '--disable-pip-version-check', *row])
        done.write_text(wanted)
    lacking = missing_packages()
    if lacking and system:
        if os.geteuid() != 0 or not shutil.which('apt-get'):
            raise UserError('--system installs Debian packages as root',
                            'another user, or no apt-get',
                            f'sudo apt install {" ".join(lacking)}')
        _run(['apt-get', 'update', '-qq'])
        _run(['apt-get', 'install', '-y', '-qq', '--no-install-recommends', *lacking])
        lacking = missing_packages()
    needs = f'; it still needs: apt install {" ".join(lacking)}' if lacking else ''
    return f'{target}: dmhouse 1.0.10 (DeepMind Lab, GPL-2.0){needs}'


def _run(command: list[str]) -> None:
    result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                            env=os.environ | {'DEBIAN_FRONTEND': 'noninteractive'})
    if result.returncode:
        lines = result.stdout.strip().splitlines()
        raise UserError(f'{" ".join(command[:6])} succeeds', lines[-1] if lines else 'no word',
                        'correct it and try again')
