"""Recipes of docs/installation.md: they agree with setup.py, package.xml and each other.

Docker and pixi do not run here; .github/workflows/install.yml runs them.
"""

import ast
import re
import tomllib
import xml.etree.ElementTree as ElementTree

import pytest
import yaml
from paths import ROOT

WORKFLOW = '.github/workflows/install.yml'
# Keys of package.xml that a recipe leaves to pip.
FROM_PIP = {'python3-gymnasium-pip', 'python3-numba', 'python3-numpy', 'python3-onnxruntime-pip',
            'python3-opencv', 'python3-rich', 'python3-rosbags-pip', 'python3-torch'}
TEST_FROM_PIP = {'python3-trimesh-pip'}
WITHOUT_KEYS = {'safetensors', 'mcap', 'zstandard', 'lz4'}  # of rosdep, 2026-08
# In the extra `test` for `make lint` and colcon's tests, which pixi's `test` does not run.
TOOLS = {'ruff', 'mypy', 'types-pyyaml', 'flake8', 'pydocstyle', 'colcon-common-extensions',
         'setuptools'}


def read(name):
    return (ROOT / name).read_text()


def requirements(extra=None):
    """What setup.py asks for, without extras: normalised name to version."""
    for node in ast.walk(ast.parse(read('setup.py'))):
        if isinstance(node, ast.keyword) and node.arg == (
                'extras_require' if extra else 'install_requires'):
            found = ast.literal_eval(node.value)
            return dict(re.match(r'([\w-]+)(?:\[.*\])?(.*)', text.lower()).groups()
                        for text in (found[extra] if extra else found))
    raise AssertionError('setup.py names no requirements')


def keys(kind):
    """The keys of package.xml."""
    return {element.text for element in ElementTree.parse(ROOT / 'package.xml').iter(kind)}


def joined(text):
    """A recipe without its line breaks and comments."""
    return re.sub(r'\s+', ' ', re.sub(r'\\\n', ' ', text))


@pytest.mark.parametrize('name', ['Dockerfile', WORKFLOW, 'docs/installation.md'])
def test_what_rosdep_leaves_out_comes_from_pip(name):
    text = joined(read(name))
    skipped = set(re.search(r'--skip-keys "([^"]+)"', text).group(1).split())
    left = FROM_PIP if name == 'Dockerfile' else FROM_PIP | TEST_FROM_PIP
    assert skipped == left and left <= keys('exec_depend') | keys('test_depend')
    constrained = re.search(r'-c src/vn_nav/constraints\.txt ([\w -]+)', text).group(1)
    installed = constrained.lower().split()
    assert set(requirements()) <= set(installed), 'pip installs less than setup.py asks for'
    assert 'python -m colcon build --base-paths src src/vn_nav/vn_interfaces' in text


def test_the_readme_installs_the_same():
    line, = re.findall(r'^pip install (torch .+)$', read('README.md'), re.MULTILINE)
    # numpy comes with torch and OpenCV, mcap brings its two.
    assert set(requirements()) - {'numpy', 'zstandard', 'lz4'} == set(line.lower().split())


def test_every_requirement_has_a_key_where_rosdep_has_one():
    declared = {re.sub(r'^python3-|-pip$', '', key) for key in keys('exec_depend')}
    names = {re.sub('^opencv-python-headless$', 'opencv', re.sub('^pyyaml$', 'yaml', name))
             for name in requirements()}
    assert names - declared == WITHOUT_KEYS
    comment = re.search(r'<!-- (rosdep has no keys .+?) -->', read('package.xml')).group(1)
    assert all(name in comment for name in WITHOUT_KEYS)


def test_the_image_runs_as_a_user_and_begins_with_help():
    lines = [line for line in re.sub(r'\\\n', ' ', read('Dockerfile')).splitlines()
             if line and not line.startswith('#')]
    assert lines[0] == 'FROM ros:jazzy'
    words = [line.split(None, 1) for line in lines]
    user, = (value for name, value in words if name == 'USER')
    assert user != 'root' and any(f'useradd --create-home --shell /bin/bash {user}' in value
                                  for name, value in words if name == 'RUN')
    copies = [value for name, value in words if name == 'COPY']
    assert copies and all(value.startswith(f'--chown={user} ') for value in copies)
    assert words[-1][0] == 'CMD' and ast.literal_eval(words[-1][1])[-1] == '--help'
    ignored = read('.dockerignore').split()
    assert {'.git', '.venv', 'build', 'install', 'log', 'runs'} <= set(ignored)
    for needed in ('package.xml', 'constraints.txt', 'setup.py', 'models', 'config', 'launch'):
        assert needed not in ignored and (ROOT / needed).exists()


def test_pixi_has_both_distributions_and_what_the_tests_need():
    pixi = tomllib.loads(read('pixi.toml'))
    assert set(pixi['workspace']['platforms']) == {'linux-64', 'linux-aarch64'}
    assert {'jazzy', 'lyrical'} <= set(pixi['environments'])
    oldest = re.search(r"python_requires='>=3\.(\d+)'", read('setup.py')).group(1)
    ros = {}
    for distribution in ('jazzy', 'lyrical'):
        feature = pixi['feature'][distribution]
        assert feature['channels'] == [f'robostack-{distribution}']
        dependencies = dict(feature['dependencies'])
        python = re.fullmatch(r'3\.(\d+)\.\*', dependencies.pop('python')).group(1)
        assert int(oldest) <= int(python) <= 14, 'the Makefile takes these'
        prefix = f'ros-{distribution}-'
        assert all(name.startswith(prefix) for name in dependencies)
        ros[distribution] = {name.removeprefix(prefix) for name in dependencies}
    assert ros['jazzy'] == ros['lyrical'] >= {'rclpy', 'common-interfaces', 'tf2-msgs',
                                              'launch-ros', 'rmw-fastrtps-cpp'}
    ours = pixi['pypi-dependencies']['vn_nav']
    assert ours['path'] == '.' and 'ros' not in ours['extras'], 'conda has ROS'
    wanted = {name: version for name, version in requirements('test').items()
              if name not in TOOLS and not name.startswith('ros-')}
    assert pixi['feature']['test']['pypi-dependencies'] == wanted


def test_pixis_tasks_run_what_make_runs():
    tasks = tomllib.loads(read('pixi.toml'))['tasks']
    makefile = read('Makefile')
    assert tasks['demo'] == 'vn_nav demo' and '$(BIN)/vn_nav demo' in makefile
    parts = [tasks[name] for name in tasks['test']['depends-on']]
    commands = [part if isinstance(part, str) else part['cmd'] for part in parts]
    marks = [re.search(r"-m '(.+?)'", command).group(1) for command in commands]
    assert marks == ['not ros and not slow', 'ros and not slow']
    workers = '-n auto --maxprocesses 8 --dist loadfile'
    assert workers in commands[0] and workers in makefile


def test_the_workflow_runs_docker_pixi_and_colcon():
    workflow = yaml.safe_load(read(WORKFLOW))
    assert set(workflow['jobs']) == {'docker', 'pixi', 'colcon'}
    pixi = tomllib.loads(read('pixi.toml'))
    for job in workflow['jobs'].values():
        assert job['timeout-minutes'] <= 60
        for step in job['steps']:
            assert len({'uses', 'run'} & set(step)) == 1
    matrix = workflow['jobs']['pixi']['strategy']['matrix']
    assert set(matrix['environment']) == set(pixi['environments']) - {'default'}
    assert len(matrix['machine']) == len(pixi['workspace']['platforms'])
    started = {step['run'].split()[-1] for step in workflow['jobs']['pixi']['steps']
               if 'run' in step}
    assert started == {'test', 'demo'} <= set(pixi['tasks'])
    assert any('docker build' in step.get('run', '') for step in
               workflow['jobs']['docker']['steps'])
    base = re.search(r'^FROM (\S+)', read('Dockerfile'), re.MULTILINE).group(1)
    assert workflow['jobs']['colcon']['container'] == base
    watched = workflow[True]['pull_request']['paths']  # `on` is YAML 1.1's true
    assert all(list(ROOT.glob(pattern)) for pattern in watched), 'a path that is not there'


def test_a_robot_without_pytorch_installs_what_its_nodes_need():
    """test/policy/test_onnx_backend.py drives without what is left out."""
    lines = [line.partition('#')[0].strip().lower() for line in
             read('requirements-robot.txt').splitlines()]
    found = dict(re.match(r'([\w-]+)(.*)', line).groups() for line in lines if line)
    whole = requirements() | requirements('onnx')
    assert set(whole) - set(found) == {'torch', 'gymnasium', 'onnx'}
    assert all(whole[name] == version for name, version in found.items())
    assert 'requirements-robot.txt' in read('docs/installation.md')
