"""One running AI2-THOR: the real `ai2thor` client, which here knows when its engine is gone.

The client as it is spins for 100 s when the engine has died, and waits for ever for one that dies
before it opens its pipe. Here every wait looks at the process as well.
"""

from __future__ import annotations

import ctypes.util
import functools
import os
import select
import shlex
import subprocess
import time
from typing import Any

from vn_nav.errors import UserError

BUILD = 'VN_NAV_THOR_BUILD'  # environment variable: the Unity executable to run
PATIENCE = 60.0  # s without an answer after which an engine hangs; loading a scene takes seconds
START_PATIENCE = 300.0  # s until the first answer
LOOK = 0.05  # s between looks at the process


class EngineLost(Exception):
    """The engine has died or hangs; what it did last is unknown."""


class Engine:
    """A Unity process and its client.

    Args:
        scene: to load first: a name, or a ProcTHOR house.
        size: side of the square pictures [pixels].
        parameters: of Unity's `Initialize`.

    Raises:
        UserError: it cannot be started here.
    """

    def __init__(self, scene: str | dict, size: int, **parameters: Any):
        options = _where()
        try:
            self._controller = _client()(
                scene=scene, width=size, height=size, server_timeout=PATIENCE,
                server_start_timeout=START_PATIENCE, **options, **parameters)
        except Exception as error:  # of several packages that the client uses
            if lost := _lost(error):
                raise UserError('the Unity engine of AI2-THOR starts on this machine', str(lost),
                                'see ~/.ai2thor/log/unity.log; it needs an X display with GLX '
                                f'(DISPLAY), or Vulkan; {BUILD} names another executable'
                                ) from error
            raise UserError('the Unity build of AI2-THOR is here, or can be fetched (once)',
                            _line(error), 'connect this machine to the network for the first '
                            f'start, or set {BUILD} to its executable') from error

    @property
    def process(self) -> subprocess.Popen:
        """Of Unity."""
        return self._controller.server.unity_proc

    @property
    def event(self) -> Any:
        """The client's, after what was done last."""
        return self._controller.last_event

    def reset(self, scene: str | dict) -> Any:
        """Load a scene by name, or a ProcTHOR house; what is seen then.

        Raises:
            EngineLost: it did not live through it.
        """
        return self._guarded(lambda: self._controller.reset(scene))

    def act(self, action: str, **arguments: Any) -> Any:
        """Do something; the client's event, of failed actions too.

        Raises:
            EngineLost: it did not live through it.
            UserError: Unity does not know such an action.
        """
        return self._guarded(lambda: self._controller.step(action=action, **arguments))

    def _guarded(self, call):
        try:
            return call()
        except EngineLost:
            raise
        except Exception as error:
            if lost := _lost(error):
                raise lost from None
            raise UserError('AI2-THOR knows the scene or the action that it is asked for',
                            _line(error), "use the build that belongs to 'ai2thor>=5,<6'"
                            ) from error

    def close(self) -> None:
        """End the process; a second time it does nothing."""
        self._controller.end()


def _lost(error: BaseException) -> EngineLost | None:
    """What the client has wrapped: its `step` raises a RuntimeError of its own."""
    cause = error if isinstance(error, EngineLost) else error.__context__
    return cause if isinstance(cause, EngineLost) else None


def _line(error: Exception) -> str:
    return ' '.join(str(error).split())[:200] or type(error).__name__


def _where() -> dict[str, Any]:
    """Arguments of the client that say which Unity to run, and where it draws."""
    build, display = os.environ.get(BUILD), os.environ.get('DISPLAY')
    if build:
        if not os.access(build, os.X_OK) or os.path.isdir(build):
            raise UserError(f'{BUILD} is the path of the Unity executable of AI2-THOR', build,
                            'correct it, or unset it and the client fetches the build')
        # The client wants a display's name with an executable of the user's.
        return {'local_executable_path': shlex.quote(build), 'x_display': display or ':0'}
    if display:
        return {'x_display': display}
    if ctypes.util.find_library('vulkan') is None:
        raise UserError('AI2-THOR draws on an X display, or by Vulkan without one',
                        'no DISPLAY, no libvulkan', 'export DISPLAY=:0 where there is a display, '
                        'or apt-get install libvulkan1 beside the driver of a GPU')
    from ai2thor.platform import CloudRendering
    return {'platform': CloudRendering}


@functools.cache
def _client():
    """The client's class with our waits; imported when an engine is asked for."""
    from ai2thor.controller import Controller
    from ai2thor.fifo_server import FieldType, FifoServer

    class Pipes(FifoServer):
        """The client's pipes; every wait ends when the engine does."""

        server_pipe: Any  # of FifoServer, which may not be installed where types are checked
        client_pipe: Any

        def _recv_message(self, timeout):
            if self.server_pipe is None:  # opening does not wait for the engine
                fd = os.open(self.server_pipe_path, os.O_RDONLY | os.O_NONBLOCK)
                self.server_pipe = os.fdopen(fd, 'rb', buffering=0)
            return super()._recv_message(timeout)

        def _read_with_timeout(self, server_pipe, message_size, timeout):
            fd, found, begun = server_pipe.fileno(), bytearray(), time.monotonic()
            while len(found) < message_size:
                try:
                    part = os.read(fd, message_size - len(found))
                except BlockingIOError:
                    part = None  # its end is open, nothing is there yet
                if part:
                    found += part
                    continue
                self._alive(begun, timeout)
                if part is None:
                    select.select([fd], [], [], LOOK)
                else:
                    time.sleep(LOOK / 5)  # not opened yet, or closed
            return bytes(found)

        def _send_message(self, message_type, body):
            begun = time.monotonic()
            while self.client_pipe is None:
                try:
                    fd = os.open(self.client_pipe_path, os.O_WRONLY | os.O_NONBLOCK)
                    self.client_pipe = os.fdopen(fd, 'wb', buffering=0)
                except OSError:  # nobody reads yet
                    self._alive(begun, self.timeout)
                    time.sleep(LOOK / 5)
            self._last_action_message = body
            rest = memoryview(self._create_header(message_type, body) + body + self.eom_header)
            while rest:
                try:
                    rest = rest[os.write(self.client_pipe.fileno(), rest):]
                except BlockingIOError:
                    self._alive(begun, self.timeout)
                    select.select([], [self.client_pipe], [], LOOK)
                except BrokenPipeError as error:
                    raise EngineLost('the engine has closed its pipe') from error

        def _alive(self, begun, timeout):
            if self.unity_proc is not None and self.unity_proc.poll() is not None:
                raise EngineLost(f'the engine has ended ({self.unity_proc.returncode})')
            if timeout is not None and time.monotonic() - begun > timeout:
                raise EngineLost(f'the engine has not answered for {timeout:g} s')

    assert FieldType.ACTION == 2  # the protocol that the waits above were written for

    class Guarded(Controller):
        """The client over these pipes; it leaves no process behind."""

        def __init__(self, **options):
            try:
                super().__init__(**options)
            except BaseException:
                self.end()
                raise

        def _build_server(self, host, port, width, height):
            self.server = Pipes(width=width, height=height, timeout=self.server_timeout,
                                depth_format=self.depth_format,
                                add_depth_noise=self.add_depth_noise)

        def end(self):
            """Kill the engine, close and remove the pipes."""
            server = getattr(self, 'server', None)
            if server is None:
                return
            server.stop()
            if server.unity_proc is not None:
                server.unity_proc.wait()
            server.tmp_dir.cleanup()
            # The client's handler at exit keeps all of this: let go of the pictures.
            server.raw_files = server.raw_metadata = server.last_event = self.last_event = None

    return Guarded
