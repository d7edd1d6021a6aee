"""ROS stays at the edge, and the packages depend on each other one way only."""

import ast
import importlib
import importlib.util
import os
import subprocess
import sys

import pytest
from paths import ROOT, TESTS

PACKAGES = ('vn_nav', 'vn_sim_bridge', 'vn_msgs_py')
# The leaves that the simulator may use, and what its node shares with the other nodes.
LEAVES = {'vn_nav.arrival', 'vn_nav.errors', 'vn_nav.goal_picture', 'vn_nav.observation',
          'vn_nav.co_visibility', 'vn_nav.labels', 'vn_nav.lens', 'vn_nav.depth_ranges',
          'vn_nav.measured_ranges', 'vn_nav.reset_arguments', 'vn_nav.resources',
          'vn_nav.robot', 'vn_nav.scenes', 'vn_nav.structured_file'}
NODE_SHARED = {'vn_nav.nodes.parameters', 'vn_nav.nodes.policy_parameters',
               'vn_nav.nodes.process', 'vn_nav.nodes.qos'}

SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob('*.py'))


def name_of(path):
    """The dotted name of a source file."""
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def at_the_edge(path):
    """Whether a source file may import ROS."""
    name = name_of(path)
    return name.startswith('vn_nav.nodes.') or name == 'vn_sim_bridge.bridge_node'


def is_ros(module):
    """Whether a module comes with ROS: a client library, a message package or a tool."""
    root = module.partition('.')[0]
    return (root.endswith(('_msgs', '_interfaces', '_srvs'))
            or root.startswith(('rcl', 'rosidl', 'rmw', 'ament_', 'launch', 'tf2', 'rosbag2_'))
            or root == 'cv_bridge')


def imported(path):
    """Every module that a file imports anywhere, functions included."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: a relative import hides what depends on what'
            # `from vn_nav import robot` may name a module as well as a function.
            names |= {node.module} | {f'{node.module}.{alias.name}' for alias in node.names
                                      if (ROOT / node.module.replace('.', '/')).is_dir()}
    return names


def roots(path):
    """The top-level packages that a file imports."""
    return {name.partition('.')[0] for name in imported(path)}


def test_every_package_is_whole():
    folders = {path.parent for path in SOURCES}
    assert {folder.name for folder in folders} >= set(PACKAGES)
    missing = [str(folder) for folder in folders if not (folder / '__init__.py').is_file()]
    assert not missing, f'pip leaves out folders without __init__.py: {missing}'


@pytest.mark.parametrize('path', SOURCES, ids=name_of)
def test_dependencies(path):
    names = imported(path)
    if not at_the_edge(path):
        assert not {name for name in names if is_ros(name)}, 'ROS is imported away from the edge'
    package = name_of(path).partition('.')[0]
    if package == 'vn_nav' and not name_of(path).startswith('vn_nav.cli.'):
        assert 'vn_sim_bridge' not in roots(path), 'only vn_nav.cli composes with the simulator'
    own = {node.module for node in ast.walk(ast.parse(path.read_text()))
           if isinstance(node, ast.ImportFrom) and node.module.partition('.')[0] in PACKAGES}
    places = {name: ROOT / name.replace('.', '/') for name in own}
    missing = [name for name, place in places.items()
               if not (place.with_suffix('.py').is_file() or place.is_dir())]
    assert not missing, f'no such module, in a function perhaps: {missing}'
    if not name_of(path).startswith('vn_nav.cli.'):
        assert 'argparse' not in roots(path), 'options of a command end in vn_nav.cli'
    if package == 'vn_sim_bridge':
        allowed = LEAVES | (NODE_SHARED if at_the_edge(path) else set())
        if name_of(path) == 'vn_sim_bridge.simulators.recorded':
            # Bags are read in one place.
            allowed = allowed | {'vn_nav.bags.mapping.recorded_place'}
        used = {name for name in names if name.startswith('vn_nav.')
                if (ROOT / name.replace('.', '/')).with_suffix('.py').is_file()}
        assert used <= allowed, f'the simulator knows only the leaves {sorted(allowed)}'
    if package == 'vn_msgs_py':
        allowed = {'numpy', 'cv2', 'vn_msgs_py'} | sys.stdlib_module_names
        if name_of(path) == 'vn_msgs_py.heic_file':  # with an extra, and refused without it
            allowed = allowed | {'pillow_heif'}
        assert roots(path) <= allowed, 'vn_msgs_py stands on NumPy and OpenCV alone'


BLOCK = """
import importlib, sys
sys.path.insert(0, {tests!r})
from test_imports import is_ros

class Absent:
    def find_spec(self, name, path=None, target=None):
        if is_ros(name):
            raise ModuleNotFoundError(f'No module named {{name!r}} (blocked)', name=name)

sys.meta_path.insert(0, Absent())
try:
    import rclpy
except ModuleNotFoundError:
    pass
else:
    raise SystemExit('the block does not work')
for name in {names!r}:
    try:
        importlib.import_module(name)
    except Exception as error:
        raise SystemExit(f'import {{name}}: {{type(error).__name__}}: {{error}}')
print('imported', len({names!r}))
"""


def test_the_rest_imports_without_ros(tmp_path):
    names = [name_of(path) for path in SOURCES if not at_the_edge(path)]
    if importlib.util.find_spec('warp') is None:  # an extra: make test-all has it
        names = [name for name in names if '.warp_' not in name]
    code = BLOCK.format(tests=str(TESTS), names=names)
    result = subprocess.run(
        [sys.executable, '-c', code], cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT), 'OMP_NUM_THREADS': '1'})
    assert result.returncode == 0, result.stdout + result.stderr
    assert f'imported {len(names)}' in result.stdout


@pytest.mark.slow
@pytest.mark.parametrize('package, heavy', [
    ('vn_nav.learning', 'torch'), ('vn_nav.evaluation', 'torch'), ('vn_nav.cli.nodes', 'argparse'),
    ('vn_nav.cli.commands', 'torch'),
    # Nodes that start in seconds, and on robots without these.
    *((f'vn_nav.nodes.{name}_node', heavy) for name in ('policy', 'recorder', 'goal', 'teleop')
      for heavy in ('torch', 'numba')), ('vn_sim_bridge.bridge_node', 'torch')])
def test_a_package_is_light_until_something_of_it_is_used(package, heavy):
    code = f"""
import sys
before = set(sys.modules)
import {package}
new = set(sys.modules) - before
sys.exit(f'{heavy} is imported' if {heavy!r} in new else 0)
"""
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize('package', ['vn_nav.learning', 'vn_nav.evaluation'])
def test_what_a_package_exports_is_what_its_name_says(package):
    """None is hidden by a module of the same name, whatever was imported before."""
    module = importlib.import_module(package)
    folder = ROOT / package.replace('.', '/')
    for name in module.__all__:
        assert callable(getattr(module, name)) and not (folder / f'{name}.py').exists()
    with pytest.raises(AttributeError, match='nothing_such'):
        getattr(module, 'nothing_such')  # noqa: B009


LIGHT = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in ('torch', 'numba', 'llvmlite', 'onnx', 'scipy'):
            raise ModuleNotFoundError(f'No module named {name!r} (blocked)', name=name)

sys.meta_path.insert(0, Absent())
from vn_nav import cli
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.slow
@pytest.mark.parametrize('words', [
    ['bag', '--help'], ['--version'], ['--help'],
    ['bag', 'doctor', 'BAG', '--checkpoint', 'models/house'],
    ['doctor', '--bag', 'BAG', '--html', 'OUT'], ['bag', 'recover', 'BAG', 'OUT'],
    ['bag', 'show', 'BAG', '--out', 'OUT'], ['bag', 'export', 'BAG', '--lerobot', 'OUT']],
    ids=' '.join)
def test_a_look_into_a_bag_takes_neither_torch_nor_numba_nor_a_gigabyte(tmp_path, words):
    if 'export' in words and importlib.util.find_spec('pyarrow') is None:
        pytest.skip('expected: pyarrow is an extra')
    places = {'BAG': str(ROOT / 'bags' / 'house_drive'), 'OUT': str(tmp_path / 'out')}
    done = subprocess.run(
        [sys.executable, '-c', LIGHT, *(places.get(word, word) for word in words)], cwd=ROOT,
        capture_output=True, text=True, env={**os.environ, 'OPENBLAS_NUM_THREADS': '1'})
    assert done.returncode == 0, done.stdout + done.stderr
