"""A headless Chromium, driven by its DevTools protocol: no library of its own."""

import asyncio
import base64
import contextlib
import json
import re
import shutil
import subprocess
import time

import aiohttp

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which(
    'google-chrome')
PATIENCE = 60.0  # s, on a loaded machine


class Browser:
    """A page. Use as a context manager; methods wait for their answers.

    Args:
        folder: for its profile.
        address: to open.
        size: of the window [pixels].
    """

    def __init__(self, folder, address, size=(1280, 1000)):
        self._folder, self._address, self._size = folder, address, size
        self._loop = asyncio.new_event_loop()
        self._number, self.errors = 0, []

    def __enter__(self):
        self._process = subprocess.Popen(
            [CHROMIUM, '--headless=new', '--no-sandbox', '--disable-gpu', '--no-first-run',
             '--disable-background-networking', '--disable-component-update',
             '--remote-debugging-port=0', f'--user-data-dir={self._folder}',
             f'--window-size={self._size[0]},{self._size[1]}', 'about:blank'],
            stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        found = None
        while found is None:
            line = self._process.stderr.readline()
            assert line, 'Chromium has ended'
            found = re.search(r'ws://(127\.0\.0\.1:\d+)/', line)
        self._wait(self._open(found.group(1)))
        return self

    async def _open(self, debugger):
        self._session = aiohttp.ClientSession()
        end = time.monotonic() + PATIENCE
        while True:
            async with self._session.get(f'http://{debugger}/json') as answer:
                pages = [p for p in await answer.json(content_type=None) if p['type'] == 'page']
            if pages:
                break
            assert time.monotonic() < end
            await asyncio.sleep(0.1)
        self._socket = await self._session.ws_connect(pages[0]['webSocketDebuggerUrl'],
                                                      max_msg_size=0)
        for name in ('Page.enable', 'Runtime.enable', 'Log.enable'):
            await self._call(name)
        await self._call('Page.navigate', url=self._address)

    def _wait(self, coroutine):
        return self._loop.run_until_complete(asyncio.wait_for(coroutine, PATIENCE))

    async def _call(self, method, **parameters):
        self._number += 1
        number = self._number
        await self._socket.send_json({'id': number, 'method': method, 'params': parameters})
        while True:
            answer = json.loads((await self._socket.receive()).data)
            if answer.get('method') == 'Runtime.exceptionThrown':
                self.errors.append(answer['params']['exceptionDetails'])
            if answer.get('method') == 'Log.entryAdded' and (
                    answer['params']['entry']['level'] == 'error'):
                self.errors.append(answer['params']['entry'])
            if answer.get('id') == number:
                assert 'error' not in answer, answer
                return answer['result']

    def call(self, method, **parameters):
        """A method of the protocol."""
        return self._wait(self._call(method, **parameters))

    def value(self, script):
        """What an expression of JavaScript is; promises are waited for."""
        result = self.call('Runtime.evaluate', expression=script, awaitPromise=True,
                           returnByValue=True)
        assert 'exceptionDetails' not in result, result
        return result['result'].get('value')

    def wait_for(self, script, seconds=PATIENCE):
        """Wait until an expression is true; while the page loads there is nothing to look at."""
        end = time.monotonic() + seconds
        while not self.value(f'(() => {{ try {{ return Boolean({script}) }} '
                             'catch { return false } })()'):
            assert time.monotonic() < end, (script, self.value('document.body.innerText'))
            time.sleep(0.05)

    def click(self, selector, x=0.5, y=0.5):
        """A real click on an element, at a share of its width and height."""
        box = self.value(f'(() => {{ const node = document.querySelector({json.dumps(selector)});'
                         'node.scrollIntoView({block: "center"});'
                         'const b = node.getBoundingClientRect();'
                         'return [b.x, b.y, b.width, b.height] })()')
        where = {'x': box[0] + x * box[2], 'y': box[1] + y * box[3], 'button': 'left',
                 'clickCount': 1}
        for kind in ('mousePressed', 'mouseReleased'):
            self.call('Input.dispatchMouseEvent', type=kind, **where)

    def press(self, key):
        """A key, by its name."""
        for kind in ('keyDown', 'keyUp'):
            self.call('Input.dispatchKeyEvent', type=kind, key=key)

    def upload(self, selector, path):
        """Choose a file."""
        root = self.call('DOM.getDocument')['root']['nodeId']
        node = self.call('DOM.querySelector', nodeId=root, selector=selector)['nodeId']
        self.call('DOM.setFileInputFiles', nodeId=node, files=[str(path)])

    def screenshot(self):
        """The window, PNG."""
        return base64.b64decode(self.call('Page.captureScreenshot', format='png')['data'])

    def __exit__(self, *_):
        with contextlib.suppress(Exception):
            self._wait(self._session.close())
        self._process.kill()
        self._process.wait()
        self._process.stderr.close()
        self._loop.close()
