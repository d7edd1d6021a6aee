"""Builds vn_interfaces with colcon on the ROS wheels of this environment.

`python test/interface_build.py` prints where its set-up file is; tests take `environment()`.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from paths import ROOT, TESTS

FOLDER = ROOT / 'build' / 'interfaces'  # kept: the next build does only what has changed
BUILD_SECONDS = 1500  # it needs few, and minutes where other work uses the cores


def what_is_missing():
    """The reason why this machine cannot build the package, or an empty string."""
    programs = [name for name in ('cmake', 'cc', 'c++') if shutil.which(name) is None]
    if programs:
        return f'no {" and no ".join(programs)} (apt install cmake build-essential)'
    if not (Path(sysconfig.get_path('include')) / 'Python.h').is_file():
        return "Python's headers are not installed (apt install python3-dev)"
    if not (Path(sys.prefix) / 'share' / 'ament_cmake').is_dir():
        return "the wheels of ament_cmake are not installed (pip install '.[interfaces]')"
    return ''


def build(folder=FOLDER):
    """Build and install below a folder; return the set-up file.

    Raises:
        RuntimeError: colcon failed; with what it printed.
    """
    search = f'{Path(sys.prefix) / "bin"}{os.pathsep}{os.environ["PATH"]}'
    result = subprocess.run(
        [sys.executable, '-m', 'colcon', '--log-base', folder / 'log', 'build',
         '--base-paths', 'vn_interfaces',
         '--build-base', folder / 'build', '--install-base', folder / 'install',
         '--cmake-args', f'-DCMAKE_PREFIX_PATH={sys.prefix}',
         f'-DPython3_EXECUTABLE={sys.executable}',
         f'-DCMAKE_PROJECT_INCLUDE={TESTS / "ros_wheels.cmake"}'],
        cwd=ROOT, capture_output=True, text=True, timeout=BUILD_SECONDS,
        env=os.environ | {'PATH': search, 'AMENT_PREFIX_PATH': sys.prefix})
    if result.returncode:
        raise RuntimeError(result.stdout + result.stderr)
    return folder / 'install' / 'local_setup.bash'


def environment(folder=FOLDER):
    """The environment of a process that imports vn_interfaces, which is built first."""
    sourced = subprocess.run(
        ['bash', '-c', 'source "$1" && env -0', '-', build(folder)],
        capture_output=True, text=True, timeout=60, check=True,
        env=os.environ | {'AMENT_PREFIX_PATH': sys.prefix})
    return dict(entry.split('=', 1) for entry in sourced.stdout.split('\0') if entry)


if __name__ == '__main__':
    if what_is_missing():
        sys.exit(f'vn_interfaces cannot be built: {what_is_missing()}')
    print(f'. {build()}')
