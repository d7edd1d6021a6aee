"""A grid scene out of any place: every cell that a robot reaches, in four headings.

Works with every simulator that puts robots anywhere and moves them (`Capabilities.teleport`).
"""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path

import h5py
import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import Action, RobotSpec
from vn_sim_bridge.grid.states import COLUMNS, NAMES, count_steps
from vn_sim_bridge.simulator import Place, Setup, Simulator
from vn_sim_bridge.simulators import open_simulator
from vn_sim_bridge.thor.frame import points_to_thor

STEP = 0.5  # m, of Zhu et al.
BATCH = 16  # robots that try moves side by side, and pictures drawn at a time
MOST_CELLS = 20_000  # a robot that still finds new ones is in no house
WHOLE = 0.01  # m that a move may fall short of a whole one
QUARTERS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])  # cells ahead, by quarter turns left


def grid_robot(robot: RobotSpec, step: float) -> RobotSpec:
    """The robot with the moves of a grid."""
    return dataclasses.replace(robot, actions=(
        Action('forward', dx=step), Action('backward', dx=-step),
        Action('rotate_left', dyaw=math.pi / 2), Action('rotate_right', dyaw=-math.pi / 2)))


def dump(scene: str, out: Path, robot: RobotSpec, *, step: float = STEP, size: int = 174) -> str:
    """Write a scene as a grid scene.

    Args:
        scene: its name.
        out: a new HDF5 file, see `grid_file`.
        robot: camera and footprint.
        step: side of a cell [m].
        size: side of the square pictures [pixels].

    Returns:
        What was written, in a line.

    Raises:
        UserError: no such scene, a simulator that puts no robots anywhere, an `out` that is there.
    """
    if out.exists():
        raise UserError('a dump is a new file', str(out), 'remove it, or choose another name')
    if not 0.05 <= step <= 10 or not 8 <= size <= 2048:
        raise UserError('cells have 0.05 to 10 m and pictures 8 to 2048 pixels a side',
                        f'{step:g} m, {size} pixels', 'choose values in range')
    robot = grid_robot(robot, step)
    simulator = open_simulator([scene], Setup(BATCH, robot, size))
    try:
        can = simulator.capabilities
        if not (can.teleport and can.continuous) or can.own_actions:
            raise UserError('a grid is made of a place in which robots can be put anywhere', scene,
                            'choose another scene (vn_nav simulators)')
        place = simulator.places[0]
        cells, edges = _explore(simulator, place, step)
        return _write(out, simulator, place, robot, step, cells, edges)
    finally:
        simulator.close()


def _explore(simulator: Simulator, place: Place, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells [C,2] m, and which cell a move from each leads to [C,4 headings,2], -1: none.

    The last axis is forward and backward. The cells lie around the start nearest to the first
    goal.
    """
    starts = place.starts()[0]
    first = starts[np.hypot(*(starts - place.goals[0].pose[:2]).T).argmin()]
    number = {(0, 0): 0}
    keys, edges, tried = [(0, 0)], [], 0
    while tried < len(keys):
        here = np.array(keys[tried:])
        poses = np.zeros((len(here) * 8, 4))
        poses[:, :2] = np.repeat(first + here * step, 8, axis=0)
        quarters = np.tile(np.repeat(np.arange(4), 2), len(here))
        poses[:, 2] = (quarters * math.pi / 2 + math.pi) % (2 * math.pi) - math.pi
        sign = np.tile([1, -1], len(here) * 4)
        free = _moves(simulator, poses, sign * step)
        rows = np.full(len(poses), -1, np.int64)
        ends = np.repeat(here, 8, axis=0) + QUARTERS[quarters] * sign[:, None]
        for row in np.nonzero(free)[0]:
            key = tuple(ends[row].tolist())
            if key not in number:
                number[key] = len(keys)
                keys.append(key)
            rows[row] = number[key]
        edges.append(rows.reshape(-1, 4, 2))
        tried += len(here)
        if tried > MOST_CELLS:
            raise UserError(f'a place has at most {MOST_CELLS} cells', place.name,
                            'choose longer steps (--step)')
    if len(keys) == 1:
        raise UserError('a robot can move from cell to cell', f'no whole step of {step:g} m from '
                        f'{first.round(2).tolist()} in {place.name}', 'choose shorter steps')
    return first + np.array(keys) * step, np.concatenate(edges)


def _moves(simulator: Simulator, poses: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Which moves [K] from poses [K,4] are whole ones."""
    whole = np.zeros(len(poses), bool)
    for begin in range(0, len(poses), BATCH):
        part = slice(begin, min(begin + BATCH, len(poses)))
        robots = np.arange(part.stop - part.start)
        simulator.place(robots, poses[part])
        delta = np.zeros((len(robots), 4))
        delta[:, 0] = lengths[part]
        motion = simulator.move(delta, robots)
        gap = np.hypot(motion.delta[:, 0] - delta[:, 0], motion.delta[:, 1])
        whole[part] = ~motion.collided & (gap < WHOLE)
    return whole


def _write(out: Path, simulator: Simulator, place: Place, robot: RobotSpec, step: float,
           cells: np.ndarray, edges: np.ndarray) -> str:
    count = 4 * len(cells)  # state 4 c + q: cell c, turned left by q quarters
    quarter = np.arange(count) % 4
    poses = np.zeros((count, 4))
    poses[:, :2] = np.repeat(cells, 4, axis=0)
    poses[:, 2] = (quarter * math.pi / 2 + math.pi) % (2 * math.pi) - math.pi
    moves = edges.reshape(count, 2)
    by_kind = np.column_stack([
        *(np.where(moves[:, k] < 0, -1, 4 * moves[:, k] + quarter) for k in range(2)),
        np.arange(count) // 4 * 4 + (quarter + 1) % 4,
        np.arange(count) // 4 * 4 + (quarter - 1) % 4])  # the columns of `states`
    part = out.with_name(f'.{out.name}.part')
    try:
        with h5py.File(part, 'w') as file:
            _write_pictures(file, simulator, poses)
            file['location'] = points_to_thor(poses[:, :3] * (1, 1, 0))[:, [0, 2]]
            file['rotation'] = -90 * quarter % 360
            file['graph'] = by_kind[:, [NAMES[name] for name in COLUMNS]]
            file['shortest_path_distance'] = count_steps(by_kind).astype(np.int64)
            file.attrs['actions'] = COLUMNS
            file.attrs['goals'] = _goal_states(place, poses)
            file.attrs['camera_fov_deg'] = math.degrees(robot.camera_fov)
            file.attrs['camera_height'] = robot.camera_height
            file.attrs['scene'], file.attrs['version'] = place.name, simulator.version
        os.replace(part, out)
    except OSError as error:
        raise UserError('a dump is written into a folder with room for it', f'{out}: {error}',
                        'choose another folder') from error
    finally:
        part.unlink(missing_ok=True)
    return f'{out}: {count:,} states in {len(cells):,} cells of {step:g} m, {place.name}'


def _write_pictures(file: h5py.File, simulator: Simulator, poses: np.ndarray) -> None:
    can, count = simulator.capabilities, len(poses)
    for begin in range(0, count, BATCH):
        part = slice(begin, min(begin + BATCH, count))
        frames = simulator.view(np.zeros(part.stop - part.start, np.int64), poses[part])
        rows = {'observation': frames.rgb.transpose(0, 2, 3, 1),
                **({'depth': frames.depth} if can.depth else {}),
                **({'semantic': frames.labels} if can.labels else {})}
        for name, pictures in rows.items():
            if begin == 0:
                file.create_dataset(name, (count, *pictures.shape[1:]), pictures.dtype,
                                    chunks=(1, *pictures.shape[1:]), compression='gzip',
                                    compression_opts=1)
            file[name][part] = pictures
    if can.labels:
        file['semantic'].attrs['names'] = list(simulator.label_names)


def _goal_states(place: Place, poses: np.ndarray) -> list[int]:
    """The states nearest to the place's goals, each once."""
    states = []
    for goal in place.goals:
        gap = np.hypot(*(poses[:, :2] - goal.pose[:2]).T)
        turn = np.abs((poses[:, 2] - goal.pose[2] + math.pi) % (2 * math.pi) - math.pi)
        states.append(int(np.lexsort((turn, gap.round(6)))[0]))
    return list(dict.fromkeys(states))
