"""The Makefile answers an unsuitable machine in one line, and keeps a sourced ROS out."""

import os
import shutil
import subprocess

import pytest
from paths import ROOT

SOURCED = {  # what the set-up of another ROS, or another environment of ROS wheels, leaves behind
    'PYTHONPATH': '/opt/ros/humble/lib/python3.10/site-packages',
    'LD_LIBRARY_PATH': '/opt/ros/humble/lib',
    'AMENT_PREFIX_PATH': '/opt/ros/humble',
    'CMAKE_PREFIX_PATH': '/opt/ros/humble',
    'COLCON_PREFIX_PATH': '/home/user/ws/install',
    'ROS_DISTRO': 'humble',
    'ROS_PYTHON_VERSION': '3',
    'ROS_LOCALHOST_ONLY': '1',
    'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp',
    'CYCLONEDDS_URI': 'file:///home/user/cyclonedds.xml',
    'FASTRTPS_DEFAULT_PROFILES_FILE': '/home/user/fastdds.xml',
    '_ROS_WHEELS_BOOTSTRAP_COMPLETE': '1',
}


@pytest.fixture
def folder(tmp_path):
    """A fresh checkout, as far as the set-up reads it, and a folder of programs of its own."""
    for name in ('Makefile', 'setup.py', 'constraints.txt'):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / 'bin').mkdir()
    return tmp_path


def program(folder, name, script):
    path = folder / 'bin' / name
    path.write_text(f'#!/bin/sh\n{script}\n')
    path.chmod(0o755)


def make(folder, *arguments, **environment):
    base = {name: value for name, value in os.environ.items()
            if not name.startswith(('MAKE', 'MFLAGS'))}
    base['PATH'] = f'{folder / "bin"}{os.pathsep}{base["PATH"]}'
    return subprocess.run(['make', *arguments], cwd=folder, env={**base, **environment},
                          capture_output=True, text=True, timeout=60)


def answer(result, folder):
    """The one line that an unsuitable machine gets; nothing has been made."""
    assert result.returncode != 0 and not (folder / '.venv').exists()
    lines = [line for line in (result.stdout + result.stderr).splitlines()
             if not line.startswith('make: ***')]
    assert len(lines) == 1, lines
    return lines[0]


def test_another_architecture(folder):
    program(folder, 'uname', '[ "$1" = -m ] && echo aarch64 || echo Linux')
    assert 'ROS 2 Jazzy from apt' in answer(make(folder, 'demo'), folder)


def test_no_python(folder):
    line = answer(make(folder, 'test', 'PYTHON=python-that-nobody-has'), folder)
    assert "there is no 'python-that-nobody-has'" in line and 'apt install' in line


def test_an_old_python(folder):
    program(folder, 'python3', '[ "$1" = -V ] && echo Python 3.10.12; exit 1')
    line = answer(make(folder, 'test'), folder)
    assert 'python3 is Python 3.10.12' in line and 'make PYTHON=' in line


def test_a_python_without_venv(folder):
    program(folder, 'python3', 'case "$2" in *ensurepip*) exit 1;; esac')
    assert 'apt install python3-venv' in answer(make(folder, 'test'), folder)


def test_a_sourced_ros_stays_outside(folder):
    result = make(folder, '--eval', 'show:; @env', 'show', ROS_DOMAIN_ID='42', **SOURCED)
    assert result.returncode == 0, result.stderr
    seen = dict(line.split('=', 1) for line in result.stdout.splitlines() if '=' in line)
    ours = {
        'AMENT_PREFIX_PATH': str(folder / '.venv'),
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(folder / 'config' / 'fastdds_localhost.xml'),
        'FASTDDS_DEFAULT_PROFILES_FILE': str(folder / 'config' / 'fastdds_localhost.xml'),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
        'ROS_DOMAIN_ID': '42',
    }
    assert {name: value for name, value in seen.items() if name in SOURCED or name in ours} == ours
