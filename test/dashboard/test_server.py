"""The dashboard's server alone, before a robot whose policy does not answer."""

import asyncio
import threading
import time

from aiohttp.test_utils import TestClient, TestServer

from vn_nav.dashboard.access import Access
from vn_nav.dashboard.server import application

REQUESTS = 40  # more than asyncio has threads
BUSY = 'what was asked before still waits for its answer'


class Silent:
    """Answers a stop, and nothing else before it is released."""

    watched, recorded = False, None

    def __init__(self):
        self.released, self.asked = threading.Event(), []

    def ask(self, name):
        """Of the policy."""
        self.asked.append(name)
        assert name == 'stop' or self.released.wait(60)
        return True, f'{name}: done'

    def show_file(self, path):
        """A goal."""
        assert self.released.wait(60)
        return path.name


async def press(robot, uploads):
    """Enable where nothing answers, stop, enable; what each of the three said."""
    async with TestClient(TestServer(application(robot, Access('127.0.0.1', '')))) as client:
        async def said(name, body=b''):
            async with client.post(f'/{name}', data=body) as answer:
                return await answer.json()

        goals = [asyncio.ensure_future(said('goal', b'x')) for _ in range(uploads)]
        await asyncio.sleep(1.0)  # each has a thread now, or waits for one
        first = asyncio.ensure_future(said('enable'))
        await asyncio.sleep(1.0)
        assert await said('reset') == {'done': False, 'message': BUSY}
        begun = time.monotonic()
        stops = await asyncio.gather(said('stop'), said('stop'))
        assert all(one['done'] for one in stops) and time.monotonic() - begun < 20
        robot.released.set()
        await asyncio.gather(*goals)
        return await first, await said('enable')


def test_a_stop_waits_behind_nothing():
    robot = Silent()
    first, after = asyncio.run(press(robot, REQUESTS))
    assert robot.asked[0] == 'stop', 'every other thread is busy'
    assert first == {'done': False, 'message': 'a stop came first'}
    assert after['done'] and robot.asked[-1] == 'enable', 'what is asked later is done'
    assert robot.asked.count('enable') == 1


def test_one_thing_at_a_time_beside_a_stop():
    robot = Silent()
    first, after = asyncio.run(press(robot, 0))
    assert robot.asked[:2] == ['enable', 'stop'] and first['done'] and after['done']
