"""The dashboard's web server: pages, a WebSocket that shows, requests that act. No ROS here.

What it shows and does is a `Robot`; `nodes/dashboard_node` is one.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import json
import os
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from aiohttp import WSMsgType, web

from vn_nav.dashboard.access import COOKIE, Access, same_origin
from vn_nav.errors import UserError

if TYPE_CHECKING:  # bags are read where somebody gives one: a robot may lack what reads them
    from vn_nav.dashboard.recorded_goals import RecordedGoals

STATIC = Path(__file__).parent / 'static'
FILES = {'dashboard.js': 'text/javascript', 'dashboard.css': 'text/css',
         'icon.svg': 'image/svg+xml'}
CAMERA, GOAL, MAP = 1, 2, 3  # first byte of a picture on the WebSocket
STATE_S, MAP_S = 0.2, 1.0  # between two looks for something new [s]
MOST_UPLOAD = 128_000_000  # bytes, as of a goal's file
SEND_S = 5.0  # a browser that takes longer for a message is dropped
HEADERS = {  # nothing is loaded from elsewhere, no other page may frame this one
    'Content-Security-Policy': "default-src 'self'; img-src 'self' blob:; frame-ancestors 'none'",
    'X-Content-Type-Options': 'nosniff', 'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-store'}
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Robot(Protocol):
    """What the page shows and does. Methods block, and are called from other threads."""

    watched: bool  # set here: somebody looks, so that pictures are wanted
    recorded: RecordedGoals | None

    def state(self) -> dict[str, Any]:
        """For JSON: what the page says in words and numbers."""

    def camera(self) -> tuple[int, bytes] | None:
        """Number and JPEG of the newest picture; None: there is none."""

    def goal(self) -> tuple[int, bytes] | None:
        """The same of the goal's picture."""

    def map(self) -> tuple[int, bytes] | None:
        """Number and PNG of the map; None: the policy has none."""

    def ask(self, name: str) -> tuple[bool, str]:
        """Of the policy: enable, stop or reset; whether it did, and what it says."""

    def drive_to(self, place: str) -> tuple[bool, str]:
        """Along the route, to a place by its name; whether that was asked, and what is said."""

    def show_file(self, path: Path) -> str:
        """Show it a goal from a file; what was shown. Raises `UserError`."""

    def show_recorded(self, number: int) -> str:
        """Show it a goal of `recorded`; what was shown."""


def application(robot: Robot, access: Access, *, camera_rate: float = 5.0) -> web.Application:
    """The web application.

    Args:
        robot: to show and to drive.
        access: who may.
        camera_rate: pictures a second at most [Hz].
    """
    server = _Server(robot, access, camera_rate)
    app = web.Application(middlewares=[server.guard], client_max_size=MOST_UPLOAD)
    app.on_cleanup.append(server.end)
    app.add_routes([
        web.get('/', server.page), web.get('/live', server.live), web.get('/bag', server.bag),
        web.get('/bag/{number}.jpg', server.thumbnail), web.post('/goal', server.upload),
        web.post('/goal/{number}', server.choose), web.post('/place', server.place),
        *(web.post(f'/{name}', server.act) for name in ('enable', 'stop', 'reset')),
        *(web.get(f'/{name}', server.file) for name in FILES)])
    return app


async def serve(app: web.Application, host: str, port: int, ended: threading.Event | Any,
                on_ready: Callable[[int], None]) -> None:
    """Serve until `ended` is set.

    Args:
        app: of `application`.
        host, port: to bind; port 0: any that is free.
        ended: has `is_set()`.
        on_ready: called with the port.

    Raises:
        UserError: the address cannot be had.
    """
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        site = web.TCPSite(runner, host, port)
        try:
            await site.start()
        except OSError as error:
            raise UserError('the dashboard has an address of its own',
                            f'{host}:{port}: {error.strerror or error}',
                            'set host and port to others') from error
        on_ready(runner.addresses[0][1])
        while not ended.is_set():
            await asyncio.sleep(0.1)
    finally:
        await runner.cleanup()


class _Server:
    def __init__(self, robot: Robot, access: Access, camera_rate: float):
        self._robot, self._access, self._camera_s = robot, access, 1 / camera_rate
        self._watchers = 0
        # A stop waits behind nothing: its thread does nothing else.
        self._stopper = concurrent.futures.ThreadPoolExecutor(1, 'stop')
        self._stopping: asyncio.Future | None = None  # the newest stop
        self._stops = 0  # that were asked for
        self._acting = False  # something else than a stop waits for its answer

    @web.middleware
    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse whom the rule does not know. A stop is everybody's: it makes nothing worse."""
        if request.path != '/stop' or request.method != 'POST':
            host = request.headers.get('Host')
            if not self._access.knows_host(host):
                raise web.HTTPForbidden(text='ask for this machine by its own name: 127.0.0.1')
            changes = request.method != 'GET' or request.path == '/live'
            if changes and not same_origin(request.headers.get('Origin'), host):
                raise web.HTTPForbidden(text='another page asks: open the dashboard itself')
            if (shown := request.query.get('token')) is not None and request.path == '/':
                if not self._access.allows(shown):
                    raise web.HTTPForbidden(text='that is another token')
                moved = web.HTTPFound('/')
                moved.set_cookie(COOKIE, shown, httponly=True, samesite='Strict')
                raise moved
            bearer = request.headers.get('Authorization', '').removeprefix('Bearer ')
            if not self._access.allows(request.cookies.get(COOKIE) or bearer):
                raise web.HTTPForbidden(text='the address that dashboard_node printed has the '
                                        'token: open that one')
        answer = await handler(request)
        if not answer.prepared:
            answer.headers.update(HEADERS)
        return answer

    async def page(self, _request: web.Request) -> web.Response:
        """The page."""
        return web.Response(text=(STATIC / 'dashboard.html').read_text(), content_type='text/html')

    async def file(self, request: web.Request) -> web.Response:
        """Its style and its script."""
        name = request.path.lstrip('/')
        return web.Response(text=(STATIC / name).read_text(), content_type=FILES[name])

    async def act(self, request: web.Request) -> web.Response:
        """Enable, stop, reset."""
        name = request.path.lstrip('/')
        if name != 'stop':
            return await self._answer(self._robot.ask, name)
        self._stops += 1
        if self._stopping is None or self._stopping.done():  # else it is asked for already
            self._stopping = asyncio.get_running_loop().run_in_executor(
                self._stopper, self._robot.ask, name)
        done, said = await asyncio.shield(self._stopping)
        return web.json_response({'done': done, 'message': said})

    async def _answer(self, act: Callable[[str], tuple[bool, str]], what: str) -> web.Response:
        """What an act of the robot answers; one at a time, and none that waited for a stop."""
        if self._acting:
            return _refused('what was asked before still waits for its answer')
        stops = self._stops

        def act_first() -> tuple[bool, str]:
            return act(what) if self._stops == stops else (False, 'a stop came first')

        self._acting = True
        try:
            done, said = await asyncio.to_thread(act_first)
        finally:
            self._acting = False
        return web.json_response({'done': done, 'message': said})

    async def end(self, _app: web.Application) -> None:
        """Let go of the thread."""
        self._stopper.shutdown(wait=False, cancel_futures=True)

    async def place(self, request: web.Request) -> web.Response:
        """A place of the route: the body is its name."""
        try:
            place = (await request.read()).decode()
        except ValueError:
            return _refused('the name of a place is UTF-8')
        return await self._answer(self._robot.drive_to, place)

    async def upload(self, request: web.Request) -> web.Response:
        """A goal from a file that the browser sends: the body is the file."""
        path = await asyncio.to_thread(_new_file)
        try:
            with open(path, 'wb') as file:
                async for part in request.content.iter_chunked(1 << 16):
                    if file.tell() + len(part) > MOST_UPLOAD:
                        return _refused(f'a picture has at most {MOST_UPLOAD / 1e6:.0f} MB')
                    file.write(part)
            return await self._show(self._robot.show_file, path)
        finally:
            path.unlink(missing_ok=True)

    async def choose(self, request: web.Request) -> web.Response:
        """A goal from the bag."""
        return await self._show(self._robot.show_recorded, self._number(request))

    async def _show(self, show: Callable[[Any], str], what: Any) -> web.Response:
        try:
            said = await asyncio.to_thread(show, what)
        except UserError as error:
            return _refused(f'{error.rule}; {error.remedy}')
        return web.json_response({'done': True, 'message': said})

    async def bag(self, _request: web.Request) -> web.Response:
        """What can be chosen from the bag: its path, and poses of its pictures."""
        recorded = self._robot.recorded
        if recorded is None:
            return web.json_response(None)
        return web.json_response({
            'name': recorded.name, 'path': recorded.path.round(3).tolist(),
            'poses': [goal.pose.round(4).tolist() for goal in recorded.goals]})

    async def thumbnail(self, request: web.Request) -> web.Response:
        """A picture of the bag, small."""
        number = self._number(request)
        assert self._robot.recorded is not None
        return web.Response(body=self._robot.recorded.goals[number].thumbnail,
                            content_type='image/jpeg')

    def _number(self, request: web.Request) -> int:
        """Of a picture of the bag, in the address."""
        recorded, text = self._robot.recorded, request.match_info['number']
        if recorded is None or not text.isdecimal() or int(text) >= len(recorded.goals):
            raise web.HTTPNotFound(text='the bag has no such picture')
        return int(text)

    async def live(self, request: web.Request) -> web.WebSocketResponse:
        """What changes, as it changes: JSON of the state, and pictures."""
        socket = web.WebSocketResponse(heartbeat=5.0, max_msg_size=1024)
        await socket.prepare(request)
        self._watchers += 1
        self._robot.watched = True
        shows = asyncio.ensure_future(self._show_live(socket))
        # A page that is shown nothing any more connects anew.
        shows.add_done_callback(lambda _: asyncio.ensure_future(socket.close()))
        try:
            async for message in socket:  # the page says nothing; its end is what is waited for
                if message.type == WSMsgType.ERROR:
                    break
        finally:
            self._watchers -= 1
            self._robot.watched = self._watchers > 0
            shows.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError, TimeoutError):
                await shows
        return socket

    async def _show_live(self, socket: web.WebSocketResponse) -> None:
        robot, said, said_at = self._robot, '', 0.0
        seen: dict[int, int] = {}
        pictures = {CAMERA: (robot.camera, self._camera_s), GOAL: (robot.goal, STATE_S),
                    MAP: (robot.map, MAP_S)}
        due = dict.fromkeys(pictures, 0.0)
        while not socket.closed:
            text = json.dumps(await asyncio.to_thread(robot.state))
            if text != said or time.monotonic() - said_at > 1.0:
                said, said_at = text, time.monotonic()
                await asyncio.wait_for(socket.send_str(text), SEND_S)
            for kind, (look, period) in pictures.items():
                if time.monotonic() < due[kind]:
                    continue
                due[kind] = time.monotonic() + period
                found = await asyncio.to_thread(look)
                if found is not None and seen.get(kind) != found[0]:
                    seen[kind] = found[0]
                    await asyncio.wait_for(socket.send_bytes(bytes([kind]) + found[1]), SEND_S)
            await asyncio.sleep(min(STATE_S, self._camera_s))


def _refused(message: str) -> web.Response:
    return web.json_response({'done': False, 'message': message})


def _new_file() -> Path:
    handle, name = tempfile.mkstemp(prefix='vn_nav-goal-')
    os.close(handle)
    return Path(name)
