"""Walking through a house with the keyboard, in a real (pseudo) terminal."""

import os
import pty
import select
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

from vn_nav.cli import main
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.tools.walk import Walk, as_text


def test_keys_move_turn_look_and_change_the_light():
    walk = Walk('house:7?rooms=2', 48, load_randomisation('standard'))
    start, first = walk.simulator.poses[0].copy(), walk.look()[0]
    assert walk.press('a') and walk.simulator.poses[0, 2] > start[2]
    assert walk.press('d') and np.allclose(walk.simulator.poses[0], start)
    assert walk.press('r') and walk.simulator.poses[0, 3] < 0 and walk.press('f')
    assert walk.press('l') and not np.array_equal(walk.look()[0], first)
    for _ in range(60):
        walk.press('w')
    assert walk.touched and 'touching' in walk.look()[1]
    assert not walk.press('x')


def test_other_scenes_are_looked_at_as_well(tmp_path):
    walk = Walk('examples.corridor:5', 24)
    picture, words = walk.look()
    assert picture.shape == (24, 24, 3) and 'wall at' in words and 'doorway' not in words
    assert walk.press('w')
    path = tmp_path / 'sheet.png'
    assert main(['house', 'show', '--scene', 'examples.corridor:5', '--out', str(path)]) == 0
    assert cv2.imread(str(path)).std() > 20


def test_a_picture_as_text_has_a_half_block_for_two_pixels():
    picture = np.zeros((32, 32, 3), np.uint8)
    picture[:16] = (255, 0, 0)
    text = as_text(picture, 16)
    assert text.count('\u2580') == 16 * 8 and '38;2;255;0;0' in text and '48;2;0;0;0' in text


@pytest.mark.slow
def test_it_runs_in_a_terminal_and_leaves_it_as_it_was():
    master, slave = pty.openpty()
    environment = {key: value for key, value in os.environ.items()
                   if key not in ('DISPLAY', 'WAYLAND_DISPLAY')}
    process = subprocess.Popen(
        [sys.executable, '-m', 'vn_nav.cli', 'house', 'walk', '--rooms', '2'], stdin=slave,
        stdout=slave, stderr=slave, env=environment | {'COLUMNS': '60', 'LINES': '30'},
        start_new_session=True)
    os.close(slave)
    output, sent, deadline = b'', [b'w', b'\x1b[D', b'l', b'x'], time.monotonic() + 60
    try:
        while time.monotonic() < deadline and process.poll() is None:
            if select.select([master], [], [], 0.2)[0]:
                try:
                    output += os.read(master, 65536)
                except OSError:
                    break
            elif sent and b'\xe2\x96\x80' in output:
                os.write(master, sent.pop(0))
        assert process.wait(10) == 0, output[-500:]
    finally:
        process.kill()
        os.close(master)
    assert output.count(b'\x1b[H') >= 3  # a picture for each key
    assert output.rstrip().endswith(b'\x1b[?1049l')


@pytest.mark.slow
def test_without_a_terminal_it_says_so():
    environment = {key: value for key, value in os.environ.items()
                   if key not in ('DISPLAY', 'WAYLAND_DISPLAY')}
    done = subprocess.run([sys.executable, '-m', 'vn_nav.cli', 'house', 'walk'], text=True,
                          capture_output=True, stdin=subprocess.DEVNULL, env=environment)
    assert done.returncode == 2 and 'display or a terminal' in done.stderr
