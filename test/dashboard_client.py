"""dashboard_node as a process, asked as a browser would."""

import asyncio
import contextlib
import json
import re
import time
import urllib.error
import urllib.request

import aiohttp
from ros_harness import PATIENCE, child


def wait_until(condition, what=''):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.05)


@contextlib.contextmanager
def dashboard(log, **parameters):
    """The node, and where it serves."""
    with child('vn_nav.nodes.dashboard_node', log, port=0, **parameters) as process:
        wait_until(lambda: 'open http' in log.read_text() or process.poll() is not None)
        found = re.search(r'open (http://\S+)', log.read_text())
        assert found, log.read_text()
        yield found.group(1), process


def post(address, data=b'', **headers):
    """The status and the answer of a POST."""
    request = urllib.request.Request(address, data=data, method='POST', headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def status(address, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers),
                                    timeout=30) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def live(address, until, **options):
    """The messages of the WebSocket, up to one that `until` likes."""
    async def listen():
        heard = []
        async with aiohttp.ClientSession() as session, session.ws_connect(
                f'{address}live', **options) as socket:
            while not heard or not until(heard[-1]):
                message = await socket.receive()
                assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY), message
                heard.append(json.loads(message.data) if isinstance(message.data, str)
                             else message.data)
        return heard
    return asyncio.run(asyncio.wait_for(listen(), PATIENCE))
