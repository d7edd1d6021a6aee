"""The dashboard and routes on a robot that has what requirements-robot.txt names, and aiohttp."""

import subprocess
import sys

import pytest
from paths import ROOT
from without import BLOCKED

pytestmark = pytest.mark.ros


@pytest.mark.parametrize('modules', [
    'vn_nav.nodes.dashboard_node, vn_nav.dashboard.server',
    'vn_nav.nodes.route_node, vn_nav.cli.goal, vn_nav.nodes.route_client'])
def test_they_need_neither_pytorch_nor_what_reads_bags(modules):
    code = BLOCKED.format(modules=('torch', 'gymnasium', 'rich', 'rosbags', 'onnx')) + (
        f'import {modules}')
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
