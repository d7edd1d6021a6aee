"""The end of a process that its middleware does not let go. No ROS here."""

import subprocess
import sys

import pytest
from paths import ROOT

STUCK = 'ctypes.PyDLL(None).pause()'  # in C, with the interpreter's lock


@pytest.mark.parametrize(('body', 'code'), [(STUCK, 3), ('pass', 4)])
def test_a_process_ends_within_its_time_with_its_code(body, code):
    script = ('import ctypes, sys, time\n'
              'from vn_nav.nodes.signals import leaving_within\n'
              f'with leaving_within(1, 3): {body}\n'
              'time.sleep(1.5)\n'  # a timer that was not taken back would come now
              'sys.exit(4)\n')
    assert subprocess.run([sys.executable, '-c', script], cwd=ROOT, timeout=60).returncode == code
