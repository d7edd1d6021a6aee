"""policy_node by ONNX Runtime alone, without PyTorch; and without Numba where none is used."""

import time

import pytest
from fake_robot import broken_node
from ros_harness import child, wait_until, write_checkpoint
from small_search import write_small_search
from without import BLOCKED

from vn_nav.cli import main
from vn_nav.policy.checkpoint import load_checkpoint

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(200)]
pytest.importorskip('onnx', reason='expected: onnx, of the extra `onnx`, is not installed')


def test_it_takes_the_export_in_a_checkpoints_folder(tmp_path):
    folder = write_checkpoint(tmp_path / 'checkpoint')
    assert main(['export', str(folder)]) == 0
    log = tmp_path / 'log'
    with child('vn_nav.nodes.policy_node', log, checkpoint=folder):
        wait_until(lambda: f'computed by ONNX Runtime ({folder}/onnx)' in log.read_text(),
                   lambda: time.sleep(0.1), what=log.read_text)


@pytest.mark.parametrize(('write', 'modules'), [
    (write_checkpoint, ('torch', 'gymnasium', 'numba')),
    (write_small_search, ('torch', 'gymnasium'))])
def test_it_drives(write, modules, tmp_path):
    from vn_nav.policy.export import export_onnx
    export_onnx(load_checkpoint(write(tmp_path / 'checkpoint')), tmp_path / 'onnx')
    with broken_node(tmp_path / 'onnx', tmp_path, BLOCKED.format(modules=modules),
                     mode='continuous') as (robot, process):
        robot.show_goal()
        robot.enable()
        wait_until(robot.moving, robot.spin, what=(tmp_path / 'log').read_text)
        assert process.poll() is None
