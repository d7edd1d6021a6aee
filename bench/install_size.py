"""What pip downloads for vn_nav: all of it, and what a robot needs that drives by an export.

    python bench/install_size.py

Prints one JSON line each: the wheels' size [MB], without ROS, and the largest of them. With the
versions of `constraints.txt`, for this Python and machine; from the network.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from common import report

ROOT = Path(__file__).resolve().parents[1]


def wheels(*words: str) -> dict[str, float]:
    """MB of each wheel that pip would install, by its name."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, '-m', 'pip', 'download', '-q', '-d', folder, '--only-binary', ':all:',
             '-c', str(ROOT / 'constraints.txt'), *words], cwd=ROOT)
        if done.returncode:
            raise SystemExit(f'expected: pip downloads {" ".join(words)}; received: exit code '
                             f'{done.returncode}, see above')
        return {path.name.partition('-')[0]: path.stat().st_size / 1e6
                for path in Path(folder).iterdir()}


def main() -> int:
    """Command line."""
    for name, words in (('all of vn_nav', ['.']),
                        ('a robot', ['-r', 'requirements-robot.txt'])):
        found = wheels(*words)
        largest = sorted(found, key=lambda package: -found[package])[:4]
        report(f'wheels of {name}', [sum(found.values())], ', '.join(
            f'{package} {found[package]:.0f}' for package in largest), unit='MB')
    return 0


if __name__ == '__main__':
    sys.exit(main())
