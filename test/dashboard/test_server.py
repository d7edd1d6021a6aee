"""The dashboard's server alone, before a robot whose policy does not answer."""

import asyncio
import threading
import time

from aiohttp.test_utils import TestClient, TestServer

from vn_nav.dashboard.access import Access
from vn_nav.dashboard.server import application

REQUESTS = 40  # more than asyncio has threads


class Silent:
    """Answers a stop, and nothing else before it is released."""

    watched, recorded = False, None

    def __init__(self):
        self.released, self.asked = threading.Event(), []

    def ask(self, name):
        """Of the policy."""
        self.asked.append(name)
        if name != 'stop':
            assert self.released.wait(60)
        return True, f'{name}: done'

    def drive_to(self, place):
        """Along a route."""
        return self.ask(place)


async def press(robot, names):
    """Press buttons at once, then stop; how long the stop took, and what the others said."""
    async with TestClient(TestServer(application(robot, Access('127.0.0.1', '')))) as client:
        async def said(name):
            async with client.post(f'/{name}', data='kitchen') as answer:
                return await answer.json()

        others = [asyncio.ensure_future(said(name)) for name in names]
        while not robot.asked:
            await asyncio.sleep(0.01)
        begun = time.monotonic()
        assert (await said('stop'))['done']
        waited = time.monotonic() - begun
        robot.released.set()
        return waited, await asyncio.gather(*others)


def test_a_stop_waits_behind_nothing_and_nothing_comes_after_it():
    robot = Silent()
    waited, others = asyncio.run(press(robot, ['enable', 'reset', 'place'] * (REQUESTS // 3)))
    assert waited < 20, 'before the others were released'
    first, last = robot.asked
    assert last == 'stop', 'what waited is refused, not done later'
    assert [one['done'] for one in others].count(True) == 1
    assert {one['message'] for one in others} == {
        f'{first if first in ("enable", "reset") else "kitchen"}: done',
        'what was asked before still waits for its answer'}
