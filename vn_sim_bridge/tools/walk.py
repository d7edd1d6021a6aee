"""Walking through a scene with the keyboard: in a window, or as coloured text in a terminal."""

from __future__ import annotations

import contextlib
import math
import os
import select
import shutil
import sys
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.floor.places import with_rooms
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator

STEP, TURN = 0.25, math.radians(15)  # m, rad a key
VIEW = 512  # pixels of the window
HELP = 'w s drive   a d turn   q e sideways   r f look   l other light   x leave'
KEYS = {
    'w': (STEP, 0, 0, 0), 's': (-STEP, 0, 0, 0), 'a': (0, 0, TURN, 0), 'd': (0, 0, -TURN, 0),
    'q': (0, STEP, 0, 0), 'e': (0, -STEP, 0, 0), 'r': (0, 0, 0, -TURN), 'f': (0, 0, 0, TURN),
}
ARROWS = {'A': 'w', 'B': 's', 'C': 'd', 'D': 'a'}  # what terminals send after ESC [
TK_ARROWS = {'Up': 'w', 'Down': 's', 'Right': 'd', 'Left': 'a'}


class Walk:
    """A robot that keys move.

    Args:
        scene: its name.
        size: side of the pictures [pixels].
        randomisation: what 'l' draws another light from.
    """

    def __init__(self, scene: str, size: int, randomisation: Randomisation | None = None):
        self.lights, self.touched = 0, False
        self.simulator = open_simulator([scene], Setup(1, RobotSpec(), size,
                                                       randomisation=randomisation))
        self.place = self.simulator.places[0]
        if self.simulator.capabilities.teleport:
            x, y, yaw, _ = self.place.goals[0].pose
            self.simulator.place(np.array([0]), np.array([[x, y, yaw, 0.0]]))
        else:
            self.simulator.spawn(np.array([0]), np.array([0], np.uint64))

    def press(self, key: str) -> bool:
        """Act on a key; False when it means to leave."""
        if key in ('x', '\x03', '\x04'):
            return False
        if key in KEYS:
            motion = self.simulator.move(np.array([KEYS[key]], float))
            self.touched = bool(motion.collided[0])
        elif key == 'l':
            self.lights += 1
            self.simulator.apply_appearance(np.array([0]), 0, Stream.APPEARANCE, 0, self.lights)
        return True

    def look(self) -> tuple[np.ndarray, str]:
        """What the robot sees, [S,S,3] uint8 RGB; where it is and what it looks at."""
        frames = self.simulator.observe()
        picture = np.ascontiguousarray(frames.rgb[0].transpose(1, 2, 0))
        middle = frames.depth.shape[1] // 2
        x, y, yaw, pitch = self.simulator.poses[0]
        can, seen = self.simulator.capabilities, ''
        if can.labels:
            label = int(frames.labels[0, middle, middle])
            seen = self.simulator.label_names[label].replace('_', ' ')
        if can.depth:
            seen += f' at {frames.depth[0, middle, middle]:.2f} m'
        room = f'{self._room(x, y) or "doorway"}   ' if can.rooms else ''
        status = (f'{room}x {x:.2f}  y {y:.2f} m  heading {math.degrees(yaw):.0f}  '
                  f'tilt {0.0 - math.degrees(pitch):.0f} deg   {seen}'
                  f'{"   touching something" if self.touched else ""}')
        return picture, status

    def _room(self, x: float, y: float) -> str:
        """Name of the room at a point; empty: in none."""
        return next((room.name for room in with_rooms(self.place).rooms
                     if room.rect.x0 <= x <= room.rect.x1 and room.rect.y0 <= y <= room.rect.y1),
                    '')


def walk(scene: str, randomisation: Randomisation | None = None) -> None:
    """Let a person drive: in a window where there is a display, else in the terminal.

    Raises:
        UserError: neither a display nor a terminal.
    """
    if os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'):
        with contextlib.suppress(ImportError):  # Python without Tk: the terminal will do
            import tkinter
            with contextlib.suppress(tkinter.TclError):  # a display that does not answer
                return _in_window(Walk(scene, VIEW, randomisation), tkinter)
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise UserError('walking needs a display or a terminal', 'neither',
                        'run it in a terminal, or look with vn_nav house show')
    _in_terminal(scene, randomisation)


def _in_window(walk: Walk, tkinter) -> None:
    root = tkinter.Tk()
    root.title(f'vn_nav {walk.place.name}')
    view = tkinter.Label(root)
    view.pack()
    words = tkinter.Label(root, justify='left')
    words.pack()

    def show():
        header = f'P6 {VIEW} {VIEW} 255 '.encode()
        picture, status = walk.look()
        view.image = tkinter.PhotoImage(data=header + picture.tobytes(), format='PPM')
        view.configure(image=view.image)
        words.configure(text=f'{status}\n{HELP}')

    def on_key(event):
        if not walk.press(TK_ARROWS.get(event.keysym, event.char)):
            root.destroy()
            return
        show()

    root.bind('<Key>', on_key)
    show()
    root.mainloop()


def _in_terminal(scene: str, randomisation: Randomisation | None) -> None:
    import termios
    import tty
    columns, lines = shutil.get_terminal_size()
    side = max(16, min(columns, 2 * (lines - 3)))
    walk = Walk(scene, max(64, side), randomisation)
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    sys.stdout.write('\x1b[?1049h\x1b[?25l')  # another screen, no cursor
    try:
        going = True
        while going:
            picture, status = walk.look()
            sys.stdout.write('\x1b[H' + as_text(picture, side)
                             + f'\x1b[0m\x1b[K{status[:columns]}\r\n\x1b[K{HELP[:columns]}')
            sys.stdout.flush()
            for key in _keys(lambda: os.read(sys.stdin.fileno(), 64).decode(errors='ignore')):
                going = going and walk.press(key)
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
        sys.stdout.write('\x1b[?25h\x1b[?1049l')
        sys.stdout.flush()


def _keys(read: Callable[[], str]) -> Iterator[str]:
    """The keys of one read; arrows become letters, an end of the input means to leave."""
    text = read()
    if text.endswith(('\x1b', '\x1b[')) and select.select([sys.stdin], [], [], 0.05)[0]:
        text += read()  # the rest of an arrow
    if not text:
        yield 'x'
    for code, key in ARROWS.items():
        text = text.replace('\x1b[' + code, key)
    yield from text


def as_text(picture: np.ndarray, side: int) -> str:
    """A picture as lines of half blocks in 24-bit colour; two pixels stand in one character."""
    small = cv2.resize(picture, (side, side - side % 2), interpolation=cv2.INTER_AREA).astype(int)
    lines = []
    for upper, lower in zip(small[::2], small[1::2], strict=True):
        cells = (f'\x1b[38;2;{a[0]};{a[1]};{a[2]}m\x1b[48;2;{b[0]};{b[1]};{b[2]}m\u2580'
                 for a, b in zip(upper, lower, strict=True))
        lines.append(''.join(cells) + '\x1b[0m\x1b[K\r\n')
    return ''.join(lines)
