"""`pip install .` gives commands, the ament index entry and the shipped files."""

import ast
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
from paths import ROOT

import vn_nav
from vn_sim_bridge.simulators import THOR

COMMANDS = {'vn_nav', 'dashboard_node', 'goal_node', 'policy_node', 'recorder_node',
            'route_node', 'sim_bridge_node', 'teleop_node'}


@pytest.fixture
def prefix(source_copy, tmp_path):
    """What `pip install --prefix` makes of the sources."""
    prefix = tmp_path / 'prefix'
    result = subprocess.run(
        [sys.executable, '-m', 'pip', 'install', '-qq', '--disable-pip-version-check', '--no-deps',
         '--no-build-isolation', '--ignore-installed', '--prefix', str(prefix), '.'],
        cwd=source_copy, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return prefix


def packages_of(prefix):
    """Where pip put the modules below a prefix."""
    return prefix / 'lib' / f'python3.{sys.version_info.minor}' / 'site-packages'


def run(executable, prefix):
    environment = {**os.environ, 'PYTHONPATH': str(packages_of(prefix))}
    return subprocess.run([str(executable), '--help'], cwd=prefix, env=environment,
                          capture_output=True, text=True, timeout=100)


@pytest.mark.slow
def test_pip_install(prefix):
    share = prefix / 'share' / 'vn_nav'
    assert (prefix / 'share/ament_index/resource_index/packages/vn_nav').is_file()
    assert (share / 'package.xml').read_text() == (ROOT / 'package.xml').read_text()
    for folder in ('config', 'launch', 'models'):
        sources = {path.relative_to(ROOT) for path in (ROOT / folder).rglob('*')
                   if path.is_file() and not path.name.startswith('.')}
        assert sources, f'{folder}/ of the source tree is empty'
        for source in sources:
            assert (share / source).read_bytes() == (ROOT / source).read_bytes(), source
    for package in ('vn_nav', 'vn_sim_bridge', 'vn_msgs_py'):
        sources = {path.relative_to(ROOT) for path in (ROOT / package).rglob('*.py')}
        sources.add((ROOT / package / 'py.typed').relative_to(ROOT))  # PEP 561
        installed = {path.relative_to(packages_of(prefix))
                     for path in (packages_of(prefix) / package).rglob('*.*')
                     if path.suffix in ('.py', '.typed')}
        assert installed == sources
    for page in (ROOT / 'vn_nav/dashboard/static').iterdir():
        assert (packages_of(prefix) / page.relative_to(ROOT)).read_bytes() == page.read_bytes()
    assert not (packages_of(prefix) / 'vn_interfaces').exists()  # colcon builds it

    # `ros2 run` looks in lib/vn_nav and starts what is executable there.
    assert {path.name for path in (prefix / 'bin').iterdir()} == COMMANDS
    assert {path.name for path in (prefix / 'lib' / 'vn_nav').iterdir()} == COMMANDS
    assert all(os.access(prefix / 'lib' / 'vn_nav' / name, os.X_OK) for name in COMMANDS)
    direct, thin = run(prefix / 'bin/vn_nav', prefix), run(prefix / 'lib/vn_nav/vn_nav', prefix)
    assert direct.returncode == 0 and 'demo' in direct.stdout, direct.stderr
    assert (thin.returncode, thin.stdout) == (direct.returncode, direct.stdout)


@pytest.mark.ros
def test_the_ament_index_finds_it(prefix):
    code = ('from ament_index_python.packages import get_package_share_directory as share; '
            'from vn_nav.resources import share_file; import vn_nav; '
            'print(vn_nav.__file__, share("vn_nav"), share_file("config/policy.yaml"))')
    environment = {**os.environ, 'PYTHONPATH': str(packages_of(prefix)),
                   'AMENT_PREFIX_PATH': str(prefix)}
    result = subprocess.run([sys.executable, '-c', code], cwd=prefix, env=environment,
                            capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == [
        str(packages_of(prefix) / 'vn_nav' / '__init__.py'), str(prefix / 'share/vn_nav'),
        str(prefix / 'share/vn_nav/config/policy.yaml')]


def test_one_version_everywhere():
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    setup = re.search(r"version='([^']+)'", (ROOT / 'setup.py').read_text()).group(1)
    citation = re.search(r'^version: (.+)$', (ROOT / 'CITATION.cff').read_text(), re.MULTILINE)
    assert manifest.find('version').text == setup == vn_nav.__version__ == citation.group(1)


def test_the_manifest_names_every_ros_package_that_is_imported():
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    declared = {element.text for element in manifest.iter('exec_depend')}
    edges = [*(ROOT / 'vn_nav' / 'nodes').glob('*.py'), ROOT / 'vn_sim_bridge' / 'bridge_node.py',
             *(ROOT / 'launch').glob('*.py')]
    used = set()
    for path in edges:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                used.add(node.module.partition('.')[0])
            elif isinstance(node, ast.Import):
                used |= {alias.name.partition('.')[0] for alias in node.names}
    ros = {name for name in used if name.endswith(('_msgs', '_srvs', '_interfaces'))
           or name in ('rclpy', 'launch', 'launch_ros')}
    # A package of ours that is built beside this one, or not: the action is served where it is.
    assert ros - {'vn_interfaces'} <= declared, f'package.xml lacks {sorted(ros - declared)}'


def test_constraints_pin_every_direct_dependency():
    names = set()
    for node in ast.walk(ast.parse((ROOT / 'setup.py').read_text())):
        if isinstance(node, ast.keyword) and node.arg == 'install_requires':
            names |= set(ast.literal_eval(node.value))
        if isinstance(node, ast.keyword) and node.arg == 'extras_require':
            names |= {name for extra in ast.literal_eval(node.value).values() for name in extra}
    # The client of AI2-THOR is no extra: pip would bring a second OpenCV along.
    names |= set(THOR[1][1:])
    pinned = re.findall(r'^([\w-]+)==', (ROOT / 'constraints.txt').read_text(), re.MULTILINE)
    assert {re.match(r'[\w-]+', name).group() for name in names} == set(pinned)
