"""The launch files, run by `launch` where it is installed: they tell the truth about the nodes."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest
import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from paths import ROOT
from rclpy.executors import SingleThreadedExecutor
from ros_harness import PATIENCE, ask, wait_until

pytestmark = [pytest.mark.ros, pytest.mark.slow]
for package in ('launch', 'launch_ros'):
    if package in sys.modules and getattr(sys.modules[package], '__file__', None) is None:
        del sys.modules[package]  # our folder of that name, as a namespace package
pytest.importorskip('launch_ros.actions', reason='expected: launch_ros is not installed')

RUN = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
service = LaunchService(argv=sys.argv[2:], noninteractive=True)
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(
    PythonLaunchDescriptionSource(sys.argv[1]),
    launch_arguments=[word.split(':=') for word in sys.argv[2:]])]))
sys.exit(service.run())
"""


@pytest.fixture
def prefix(tmp_path):
    """What an installation puts where `FindPackageShare` and `Node` look."""
    share, lib = tmp_path / 'prefix/share/vn_nav', tmp_path / 'prefix/lib/vn_nav'
    index = tmp_path / 'prefix/share/ament_index/resource_index/packages'
    for folder in (share, lib, index):
        folder.mkdir(parents=True)
    (index / 'vn_nav').touch()
    for name in ('launch', 'config', 'models', 'package.xml'):
        (share / name).symlink_to(ROOT / name)
    for name in ('policy_node', 'sim_bridge_node'):
        (lib / name).write_text(f'#!{sys.executable}\nimport sys\nfrom vn_nav.cli.nodes import '
                                f'{name}\nsys.exit({name}())\n')
        (lib / name).chmod(0o755)
    return tmp_path / 'prefix'


@pytest.fixture
def start(prefix, tmp_path):
    """Start a launch file; the process and its log. What is left over is killed."""
    started = []

    def begin(name, *arguments):
        log = tmp_path / f'{len(started)}.log'
        paths = [str(prefix), *filter(None, [os.environ.get('AMENT_PREFIX_PATH')]), sys.prefix]
        with log.open('w') as file:
            started.append(subprocess.Popen(
                [sys.executable, '-c', RUN, str(ROOT / 'launch' / f'{name}.launch.py'),
                 *arguments], stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                start_new_session=True, cwd=tmp_path, env=os.environ | {
                    'AMENT_PREFIX_PATH': os.pathsep.join(paths), 'OMP_NUM_THREADS': '1',
                    'PYTHONPATH': os.pathsep.join(
                        [str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])]),
                    'ROS_LOG_DIR': str(tmp_path / 'ros_log')}))
        return started[-1], log
    yield begin
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def says(log, words, process, seconds=90):
    def there():
        return words in log.read_text() or process.poll() is not None
    wait_until(there, lambda: time.sleep(0.05), seconds)
    assert words in log.read_text(), log.read_text()


def pids(log):
    return [int(pid) for pid in re.findall(r'process started with pid \[(\d+)\]',
                                           log.read_text())]


@pytest.mark.parametrize('again', [False, True])
def test_ctrl_c_ends_with_exit_code_0(start, again):
    """The group gets SIGINT, as from a terminal; launch sends each node another one."""
    process, log = start('drive')
    says(log, 'waits for pictures', process)
    os.killpg(process.pid, signal.SIGINT)
    if again:
        time.sleep(0.05)
        for pid in pids(log):
            os.kill(pid, signal.SIGINT)
    assert process.wait(PATIENCE) == 0, log.read_text()
    assert 'has died' not in log.read_text()


@pytest.mark.parametrize(('file', 'content', 'word'), [
    ('drive', 'checkpoint: /nowhere', 'a checkpoint is a folder'),
    ('drive', 'control_rate: 20', 'a number with a point'),
    ('sim', 'mode: shadow', 'mode is one of'),
])
def test_a_node_that_dies_at_start_ends_the_launch_with_another_code(start, tmp_path, file,
                                                                     content, word):
    (tmp_path / 'p.yaml').write_text(f'/**:\n  ros__parameters:\n    {content}\n')
    process, log = start(file, f'params_file:={tmp_path / "p.yaml"}', 'use_respawn:=true')
    assert process.wait(PATIENCE) == 1, log.read_text()
    assert word in log.read_text() and 'Traceback' not in log.read_text()


@pytest.mark.parametrize('file', ['drive', 'sim'])
def test_a_params_file_that_is_missing_is_an_error(start, file):
    process, log = start(file, 'params_file:=/nowhere.yaml')
    assert process.wait(PATIENCE) == 1
    assert '/nowhere.yaml' in log.read_text() and not pids(log)


def test_what_an_operator_and_a_crash_leave_unconfigured_stays_so(start):
    process, log = start('drive', 'use_respawn:=true')
    rclpy.init()
    node = rclpy.create_node('operator')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    clients = {kind: node.create_client(kind, f'/policy_node/{name}') for kind, name in (
        (GetState, 'get_state'), (ChangeState, 'change_state'))}

    def call(kind, **fields):
        return ask(clients[kind], kind.Request(**fields),
                   lambda: executor.spin_once(timeout_sec=0.1))

    def state():
        return call(GetState)[0].current_state.id
    try:
        says(log, 'waits for pictures', process)
        wait_until(lambda: state() == State.PRIMARY_STATE_ACTIVE, lambda: time.sleep(0.1))
        for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP,
                           Transition.TRANSITION_CONFIGURE):
            answer, asked = call(ChangeState, transition=Transition(id=transition))
            # Asked again because the answer was lost: then it is done, and refused.
            assert answer.success or asked > 1
        time.sleep(1.5)
        assert state() == State.PRIMARY_STATE_INACTIVE
        os.kill(pids(log)[0], signal.SIGKILL)
        says(log, 'not configured: waits for', process)
        assert len(pids(log)) == 2 and log.read_text().count('waits for pictures') == 1
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(PATIENCE) == 0, log.read_text()
    finally:
        node.destroy_node()
        rclpy.shutdown()
