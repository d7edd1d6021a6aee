"""What runs beside policy_node where requirements-robot.txt and aiohttp are installed."""

import subprocess
import sys

import pytest
from paths import ROOT
from without import BLOCKED

pytestmark = pytest.mark.ros


@pytest.mark.parametrize('modules', [
    'vn_nav.nodes.dashboard_node, vn_nav.dashboard.server',
    'vn_nav.nodes.route_node, vn_nav.cli.goal, vn_nav.nodes.route_client',
    'vn_nav.nodes.recorder_node, vn_nav.nodes.teleop_node, vn_nav.nodes.goal_node',
    'vn_nav.nodes.graph_doctor, vn_nav.nodes.base_check, vn_nav.doctor.page'])
def test_they_need_no_pytorch(modules):
    done = run_without(f'import {modules}')
    assert done.returncode == 0, done.stderr


def run_without(code):
    return subprocess.run(
        [sys.executable, '-c', BLOCKED.format(modules=('torch', 'gymnasium', 'onnx')) + code],
        cwd=ROOT, capture_output=True, text=True)


@pytest.mark.parametrize('words', [
    ['doctor', '--bag', 'bags/house_drive', '--checkpoint', 'models/house'],
    ['bag', 'show', 'bags/house_drive', '--out', '{folder}/page.html'],
    ['route', 'bags/house_drive', '--out', '{folder}/route']])
def test_the_commands_of_a_bring_up_run(words, tmp_path):
    words = [word.format(folder=tmp_path) for word in words]
    done = run_without(f'from vn_nav.cli import main; sys.exit(main({words!r}))')
    assert done.returncode == 0, done.stdout + done.stderr
