"""The dashboard on a robot that has what requirements-robot.txt names, and aiohttp."""

import subprocess
import sys

import pytest
from paths import ROOT
from without import BLOCKED

pytestmark = pytest.mark.ros


def test_it_needs_neither_pytorch_nor_what_reads_bags():
    code = BLOCKED.format(modules=('torch', 'gymnasium', 'rich', 'rosbags', 'onnx')) + (
        'import vn_nav.nodes.dashboard_node, vn_nav.dashboard.server')
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
