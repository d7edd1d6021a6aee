"""dashboard_node for real: a simulated robot, the policy, the page in a headless Chromium."""

import json
import re
import signal
import time
import urllib.request

import aiohttp
import cv2
import numpy as np
import pytest
import rclpy
from browser import CHROMIUM, Browser
from dashboard_client import dashboard, live, post, status, wait_until
from paths import ROOT
from rclpy.duration import Duration
from ros_harness import PATIENCE, child, write_checkpoint
from std_msgs.msg import String

from vn_nav.nodes.qos import qos

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(240)]
BAG = ROOT / 'bags' / 'house_drive'


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    """A simulated robot and a policy that moves it anyhow."""
    folder = tmp_path_factory.mktemp('robot')
    with child('vn_sim_bridge.bridge_node', folder / 'bridge', house=7,
               max_decisions=10_000), \
            child('vn_nav.nodes.policy_node', folder / 'policy',
                  checkpoint=write_checkpoint(folder / 'checkpoint')):
        yield


def is_state(message, name):
    return isinstance(message, dict) and message['state'] == name


def photograph(path):
    picture = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    cv2.imwrite(str(path), picture)
    return path


def test_it_shows_and_asks_by_http(robot, tmp_path):
    with dashboard(tmp_path / 'log', bag=str(BAG)) as (address, _):
        heard = live(address, lambda message: isinstance(message, bytes) and message[0] == 1)
        shown = cv2.imdecode(np.frombuffer(heard[-1][1:], np.uint8), cv2.IMREAD_COLOR)
        assert shown.shape[:2] == (84, 84)
        wait_until(lambda: post(f'{address}enable')[1]['done'])
        state = live(address, lambda message: is_state(message, 'running') and (
            message['goal']['decisions'] > 0))[-1]
        assert state['level'] == 0 and float(state['values']['camera [Hz]']) > 0
        goal = state['goal']['number']
        # Another goal by a file, and one of the bag.
        code, said = post(f'{address}goal', photograph(tmp_path / 'goal.png').read_bytes())
        assert (code, said['done']) == (200, True) and '160 x 120' in said['message']
        live(address, lambda m: isinstance(m, dict) and m['goal']['number'] == goal + 1)
        assert post(f'{address}goal/0')[1]['done']
        live(address, lambda m: isinstance(m, dict) and m['goal']['number'] == goal + 2)
        code, said = post(f'{address}goal', b'this is no picture at all')
        assert code == 200 and not said['done'] and 'picture' in said['message']
        assert post(f'{address}goal/999')[0] == 404 == status(f'{address}bag/999.jpg')
        # A stop.
        code, said = post(f'{address}stop')
        assert said['done']
        live(address, lambda message: is_state(message, 'stopped'))
        assert not post(f'{address}enable')[1]['done']
        assert post(f'{address}reset')[1]['done']
        live(address, lambda message: not is_state(message, 'stopped'))
        # Nobody else's page, and no name that somebody points here.
        for name in ('enable', 'goal', 'goal/0'):
            assert post(f'{address}{name}', Origin='http://evil.example')[0] == 403
            assert post(f'{address}{name}', Host='evil.example')[0] == 403
        assert status(address, Host='evil.example') == 403
        with pytest.raises(aiohttp.WSServerHandshakeError):
            live(address, lambda _: True, origin='http://evil.example')
        assert post(f'{address}stop', Origin='http://evil.example')[0] == 200
        post(f'{address}reset')
        assert 'Traceback' not in (tmp_path / 'log').read_text()


def test_on_other_addresses_a_token_is_shown_once(tmp_path):
    with dashboard(tmp_path / 'log', host='0.0.0.0', policy='nobody') as (address, process):
        base, token = re.fullmatch(r'(http://0\.0\.0\.0:\d+/)\?token=(\S+)', address).groups()
        base = base.replace('0.0.0.0', '127.0.0.1')
        assert status(base) == status(f'{base}?token=wrong') == post(f'{base}enable')[0] == 403
        jar = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        with jar.open(f'{base}?token={token}') as answer:
            assert answer.status == 200 and 'token' not in answer.url
        with jar.open(f'{base}bag') as answer:
            assert json.loads(answer.read()) is None
        assert status(base, Authorization=f'Bearer {token}') == 200
        # A stop needs none; and where nobody hears it, that is said.
        begun = time.monotonic()
        code, said = post(f'{base}stop')
        assert code == 200 and not said['done'] and "robot's own stop" in said['message']
        assert time.monotonic() - begun < 10
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0


def test_what_somebody_else_says_leaves_the_page_alive(tmp_path):
    rclpy.init()
    node = rclpy.create_node('stranger')
    try:
        with dashboard(tmp_path / 'log', policy='nobody') as (address, _):
            for name in ('goal_status', 'goal_feedback', 'route_status'):
                publisher = node.create_publisher(String, name, qos(name))
                wait_until(publisher.get_subscription_count)
                for text in ('hello', '[]', '3', '{}'):
                    publisher.publish(String(data=text))
                assert publisher.wait_for_all_acked(Duration(seconds=20))
            wait_until(lambda: 'is JSON with' in (tmp_path / 'log').read_text())
            assert live(address, lambda _: True)[-1]['state'] == 'no policy'
            assert post(f'{address}stop')[0] == 200
    finally:
        node.destroy_node()
        rclpy.shutdown()


@pytest.mark.parametrize('words, what', [
    ({'host': '203.0.113.9'}, '203.0.113.9'), ({'token': 'short'}, 'token'),
    ({'bag': '/nowhere'}, '/nowhere'), ({'camera_rate': 99.0}, 'camera_rate')])
def test_what_it_cannot_serve_is_one_line(tmp_path, words, what):
    with child('vn_nav.nodes.dashboard_node', tmp_path / 'log', **words) as process:
        assert process.wait(PATIENCE) == 2
    lines = (tmp_path / 'log').read_text().strip().splitlines()
    assert what in lines[-1] and 'Traceback' not in str(lines)


def test_an_address_that_is_taken_is_one_line(tmp_path):
    with dashboard(tmp_path / 'one') as (address, _):
        port = int(re.search(r':(\d+)/', address).group(1))
        with child('vn_nav.nodes.dashboard_node', tmp_path / 'two', port=port) as process:
            assert process.wait(PATIENCE) == 2
    assert str(port) in (tmp_path / 'two').read_text().strip().splitlines()[-1]


@pytest.mark.skipif(CHROMIUM is None, reason='expected: Chromium is not installed')
def test_the_page_in_a_browser(robot, tmp_path):
    with dashboard(tmp_path / 'log', bag=str(BAG)) as (address, process), \
            Browser(tmp_path / 'profile', address) as page:
        def shown(name):
            return page.value(f'document.getElementById("{name}").textContent')
        page.wait_for('!document.getElementById("camera").hidden && '
                      'document.getElementById("camera").naturalWidth == 84')
        page.wait_for('document.getElementById("state").textContent == "idle"')

        def enable():  # refused while its pictures are younger than a second
            end = time.monotonic() + PATIENCE
            while shown('state') != 'running':
                assert time.monotonic() < end, shown('said')
                page.click('#enable')
                time.sleep(0.5)
        enable()
        page.wait_for('!document.getElementById("goal").hidden')
        assert page.value('getComputedStyle(document.getElementById("reset")).display') == 'none'
        # A click on the path, and one on a picture: other goals.
        page.wait_for('document.querySelectorAll("#pictures img").length >= 3')
        before = page.value('document.getElementById("goal").src')
        page.click('#path', 0.5, 0.9)
        page.wait_for('document.getElementById("said").textContent.includes("goal shown")')
        page.wait_for(f'document.getElementById("goal").src != {json.dumps(before)}')
        assert page.value('document.querySelectorAll("#pictures .chosen").length') == 1
        page.click('#pictures button:first-child')
        page.wait_for('document.querySelector("#pictures button").className == "chosen"')
        # A file that is chosen while another answer is waited for is sent after it.
        page.value('wait(1)')
        page.upload('#file', photograph(tmp_path / 'goal.png'))
        page.value('wait(-1)')
        page.wait_for('document.getElementById("said").textContent.includes("160 x 120")')
        page.wait_for('document.getElementById("goal").naturalWidth == 160')
        picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000, 'there is something to see'
        # Stop: by the button, by the keyboard.
        # The button that was pressed last, Enable, has the focus.
        for stop in (lambda: page.click('#stop'), lambda: page.press('Escape'),
                     lambda: page.press(' ')):
            enable()
            stop()
            page.wait_for('document.getElementById("state").textContent == "stopped"')
            page.wait_for('!document.getElementById("reset").hidden')
            page.click('#reset')
            page.wait_for('document.getElementById("state").textContent == "idle"')
        assert not page.errors, page.errors
        # A dashboard that is gone says so, and a stop that is not heard as well.
        process.kill()
        page.wait_for('document.getElementById("state").textContent == "not connected"')
        page.click('#stop')
        page.wait_for('document.getElementById("said").textContent.includes("own stop")')
        assert 'silent' in shown('reason')
