"""Pairs of a robot's view and a goal picture with what relates them, for supervised learning."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from vn_nav.co_visibility import co_visible, lift, relative_pose
from vn_nav.errors import UserError
from vn_nav.lens import bearings_through, squeezed_pose, squeezed_ranges, zoom_of
from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream, key, uniform
from vn_sim_bridge.datasets.lenses import Lenses, cut
from vn_sim_bridge.datasets.pair_poses import PLACERS, TRIES, USUAL
from vn_sim_bridge.datasets.view_ranges import ranges_of_depth
from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import CELL, FloorMap
from vn_sim_bridge.floor.places import FloorPlace, WalledPlace
from vn_sim_bridge.floor.rays import ray_cast
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.simulator import Frames, Place, Setup
from vn_sim_bridge.simulators import open_simulator, robot_for

WINDOW = 12  # cells around a goal that a path of the arrival radius cannot leave


class PairSampler:
    """Independent random pairs of views in some scenes.

    A goal stands on a random free cell, with free floor straight ahead. A robot stands near it
    (`pair_poses.NEARBY`, `CLOSE`, `BEHIND`: where it touches nothing) or anywhere in its place.
    Light and camera of the two are drawn apart. Everything is a function of the seed and the
    number of the draw: to go on later, keep `count` and set it again.

    Args:
        scenes: names, all of one simulator.
        size: side of the pictures [pixels].
        robot: footprint and camera; the scenes' own if left out.
        randomisation: of light and camera; default: nothing varies.
        seed: of the draws.
        threads: threads that draw.
        mix: of `pair_poses.PLACERS`, how robots stand: 'usual' as above, or 'recognition':
            about half there or where the goal is likely seen, a fifth nearly there (`BESIDE`,
            `ASKEW`), the rest in the same room turned away (`TURNED`) or anywhere.
        lenses: of the groups of `draw_groups`, where the simulator draws cameras; None: all
            have the robot's.

    Raises:
        UserError: no scene, an unknown mix, or a simulator that cannot look from anywhere.
    """

    def __init__(self, scenes: Sequence[str], size: int = 84, robot: RobotSpec | None = None,
                 randomisation: Randomisation | None = None, seed: int = 0, threads: int = 1,
                 mix: str = USUAL, lenses: Lenses | None = None):
        if len(scenes) < 1:
            raise UserError('there is at least one scene', scenes, 'name some')
        if mix not in PLACERS:
            raise UserError(f'the mix of pairs is one of {", ".join(PLACERS)}', mix, 'choose one')
        self._place = PLACERS[mix]
        self.count = 0  # pairs drawn so far
        self._seed, self._size = seed, size
        self.robot = robot_for(scenes, robot)
        self.simulator = open_simulator(scenes, Setup(1, self.robot, size, threads,
                                                      randomisation))
        self.places = list(self.simulator.places)
        can = self.simulator.capabilities
        if not can.teleport:
            self.simulator.close()
            raise UserError('random poses need a simulator that puts robots anywhere',
                            scenes[0], 'choose another simulator (vn_nav simulators)')
        if randomisation is not None and randomisation.varies_pictures and not can.appearance:
            self.simulator.close()
            raise UserError('light and camera vary in simulators that draw them',
                            'a randomisation', 'leave it out, or choose another simulator')
        self._lenses = lenses if can.appearance else None
        # On a grid robots stand where episodes may begin, and nowhere else.
        self._stands = None if can.continuous else [place.starts() for place in self.places]
        floors = list(map(standing_room, self.places))
        cells = [floor.centres() for floor in floors]
        maps = [floor.free for floor in floors]
        free = np.zeros((len(maps), *np.max([part.shape for part in maps], axis=0)), bool)
        for part, own in zip(free, maps, strict=True):
            part[:own.shape[0], :own.shape[1]] = own
        rects = [place.obstacle_rects if isinstance(place, WalledPlace) else np.zeros((0, 4))
                 for place in self.places]
        self._floors = (
            np.concatenate(cells), np.cumsum([0, *map(len, cells)]),
            np.concatenate(rects), np.cumsum([0, *map(len, rects)]), free,
            np.array([floor.origin for floor in floors]), self.robot.footprint_radius)

    def draw(self, count: int) -> dict[str, np.ndarray]:
        """The next pairs.

        Args:
            count: how many, K.

        Returns:
            image, goal: [K,3,S,S] uint8.
            goal_pose: [K,4] float32, see `co_visibility.relative_pose`.
            overlap: [K] float32, see `co_visibility.co_visible`.
            arrived: [K] bool, by the image task's rule.
            depth: [K,S,S] float32 m; segmentation, goal_segmentation: [K,S,S] class ids.
            place: [K] int64, index; pose, goal_place: [K,4] float64 in the map frame.
        """
        if count < 1:
            raise UserError('a draw has at least one pair', count, 'draw more')
        self._need_depth()
        numbers = np.arange(self.count, self.count + count)
        place, poses, goal_poses = self.poses(numbers)
        self.count += count
        goal, goal_camera = self._look(place, goal_poses, numbers, 1)
        points = lift(goal.depth, *goal_camera)
        image, camera = self._look(place, poses, numbers, 0)
        return {
            'image': image.rgb, 'goal': goal.rgb,
            'goal_pose': relative_pose(poses, goal_poses),
            'overlap': co_visible(points, image.depth, *camera),
            'arrived': self.arrived(place, poses, goal_poses),
            'depth': image.depth, 'segmentation': image.labels, 'goal_segmentation': goal.labels,
            'place': place, 'pose': poses, 'goal_place': goal_poses,
        }

    def draw_groups(self, count: int, robots: int = 3, *, bearings: np.ndarray | None = None
                    ) -> dict[str, np.ndarray]:
        """Views in groups, each of a goal and of several robots that stand about it as in a pair.

        Any two views of a group are a pair, either way round: more labels for each picture.

        Args:
            count: groups; robots: R in each.
            bearings: [C] rad, positive to the left: asks for `ranges` along them, and `arrived`.

        Returns:
            image: [V,3,S,S] uint8 of V = count * (1 + R) views, a goal before its robots.
            depth: [V,S,S] float32 m; segmentation: [V,S,S] class ids.
            first, second: [K] int64, views of the K = count * (1 + R) * R pairs; the second is
                the goal.
            goal_pose: [K,4], overlap: [K], of the pairs, as `draw` returns them.
            With bearings also arrived: [K] bool, of the pairs, and ranges: [V,C] float32 m from
            the robot's centre to the first obstacle, `vn_sim_bridge.datasets.view_ranges`.
            zoom: [K] float32 of the pairs' lens. Where it is not 1, goal_pose and ranges are
            those of the squeezed place of `vn_nav.policy.search.lens`; `arrived` is as it is.
        """
        if count < 1 or robots < 1:
            raise UserError('a draw has at least one group, and that one robot', (count, robots),
                            'draw more')
        self._need_depth()
        # The numbers of the draws go on over all robots, whatever a group's size.
        numbers = np.arange(self.count, self.count + count * robots)
        place, poses, goal_poses = self.poses(numbers, robots)
        self.count += count * robots
        size = 1 + robots
        poses = np.concatenate([goal_poses[::robots, None], poses.reshape(count, robots, 4)], 1)
        numbers = np.concatenate([numbers[::robots, None], numbers.reshape(count, robots)], 1)
        views = np.tile(np.arange(size) == 0, count)  # as in `draw`: a goal is 1, a robot 0
        poses, numbers = poses.reshape(-1, 4), numbers.reshape(-1)
        zoom = np.ones(len(poses))
        aspects, off = zoom, None
        if self._lenses is not None:
            fovs, shares, masts = self._lenses.draw(self._seed, numbers[::size], self.robot)
            off = (np.repeat(fovs - self.robot.camera_fov, size),
                   np.repeat(masts - self.robot.camera_height, size),
                   self._lenses.pitches(self._seed, np.repeat(numbers[::size], size),
                                        np.tile(np.arange(size), count)))
            zoom = np.repeat([zoom_of(own, self.robot.camera_fov) for own in fovs], size)
            aspects = np.repeat(shares, size)
        frames, (cameras, fov) = self._look(np.repeat(place[::robots], size), poses, numbers,
                                            views.astype(np.int64), off)
        cut(frames, aspects)
        points = lift(frames.depth, cameras, fov)
        first, second = np.nonzero(~np.eye(size, dtype=bool))
        start = size * np.arange(count)[:, None]
        first, second = (start + first).reshape(-1), (start + second).reshape(-1)
        found = {
            'image': frames.rgb, 'depth': frames.depth, 'segmentation': frames.labels,
            'first': first, 'second': second,
            'goal_pose': squeezed_pose(relative_pose(poses[first], poses[second]), zoom[first]),
            'zoom': zoom[first].astype(np.float32),
            'overlap': co_visible(points[second], frames.depth[first], cameras[first], fov[first]),
        }
        if bearings is not None:
            where = np.repeat(place[::robots], size)
            found |= {
                'arrived': self.arrived(where[first], poses[first], poses[second]),
                'ranges': squeezed_ranges(self._ranges(
                    where, poses, bearings_through(bearings, zoom[:, None]), frames.depth, cameras,
                    fov), np.asarray(bearings, float), zoom)}
        return found

    def _ranges(self, place: np.ndarray, poses: np.ndarray, bearings: np.ndarray,
                depth: np.ndarray, cameras: np.ndarray, fov: np.ndarray) -> np.ndarray:
        """Of views, [V,C] float32: by the places' walls where they have some, else by depth.

        Along bearings [V,C].
        """
        rects, first_rect = self._floors[2:4]
        found = ray_cast(poses, place, bearings, rects, first_rect)
        open_air = np.flatnonzero(first_rect[place] == first_rect[place + 1])
        if len(open_air):
            found[open_air] = ranges_of_depth(
                depth[open_air], cameras[open_air], fov[open_air], poses[open_air, 2],
                bearings[open_air])
        return found

    def poses(self, numbers: np.ndarray, robots: int = 1
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places [K] and poses [K,4] of robots and of goals, of some draws [K].

        With several `robots` as many rows in a row have the goal of their first one.
        """
        draws = uniform(self._seed, Stream.PAIR, numbers[:, None], 0, np.arange(3 + 5 * TRIES))
        leader = np.arange(len(numbers)) // robots * robots
        draws[:, 0], draws[:, 3:3 + 2 * TRIES] = draws[leader, 0], draws[leader, 3:3 + 2 * TRIES]
        place = (draws[:, 0] * len(self.places)).astype(np.int64)
        poses, goal_poses = np.zeros((2, len(numbers), 4))
        self._place(draws, place, *self._floors, poses, goal_poses)
        if self._stands is not None:
            for k, index in enumerate(place):
                for pose in (poses[k], goal_poses[k]):
                    _stand(pose, *self._stands[index])
        return place, poses, goal_poses

    def _need_depth(self) -> None:
        """Without depth nobody knows what two pictures share.

        Raises:
            UserError: there is none.
        """
        if not self.simulator.capabilities.depth:
            raise UserError('picture pairs need a simulator with depth', self.places[0].name,
                            'leave them out (pair_minutes=0), or choose another simulator')

    def arrived(self, place: np.ndarray, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """Whether robots [K,4] have arrived at goals [K,4], by the image task's rule, [K] bool.

        The geodesic distance is the task's own, solved in a window around each goal that holds
        every path as short as the arrival radius.
        """
        error = tasks.heading_error(poses[:, 2], goal_poses[:, 2])
        gap = poses[:, :2] - goal_poses[:, :2]
        distance = np.hypot(gap[:, 0], gap[:, 1])
        # Solved distances fall short of straight ones by no more than a cell.
        for k in np.nonzero(tasks.arrived(distance - CELL, error))[0]:
            own = self.places[place[k]]
            if not isinstance(own, FloorPlace):
                distance[k] = tasks.distance_to(own, *goal_poses[k, :2]).at(poses[k:k + 1])[0]
                continue
            floor = own.floor
            column, row = ((goal_poses[k, :2] - floor.origin) / CELL).astype(int)
            left, low = max(column - WINDOW, 0), max(row - WINDOW, 0)
            window = FloorMap(
                (floor.origin[0] + left * CELL, floor.origin[1] + low * CELL),
                np.ascontiguousarray(floor.free[low:row + WINDOW + 1, left:column + WINDOW + 1]))
            field = FloorDistance(window, *goal_poses[k, :2])
            distance[k] = field.at(poses[k:k + 1, :2])[0]
        return tasks.arrived(distance, error)

    def _look(self, place, poses, numbers, view: int | np.ndarray,
              off: tuple[np.ndarray, ...] | None = None) -> tuple[Frames, tuple]:
        """Pictures from poses, and the cameras that took them; `view` tells the two apart.

        `off` is added to their fields of view [rad], heights [m] and pitches [rad].
        """
        appearance = self.simulator.appearance(self._seed, Stream.PAIR_APPEARANCE, numbers, view)
        if off is not None:
            appearance = appearance._replace(fov=appearance.fov + off[0],
                                             height=appearance.height + off[1],
                                             pitch=appearance.pitch + off[2])
        frames = self.simulator.view(place, poses, None, appearance,
                                     key(self._seed, Stream.PAIR_SENSOR, numbers, view))
        return frames, self.simulator.cameras(poses, appearance)


def standing_room(place: Place) -> FloorMap:
    """Where in a place a robot can stand: its floor map, or what lies about its starts."""
    if isinstance(place, FloorPlace):
        return place.floor
    cells, _ = place.starts()
    some = cells[np.linspace(0, len(cells) - 1, min(len(cells), 200)).astype(int)]
    gaps = np.hypot(*(some[:, None] - cells[None]).transpose(2, 0, 1))
    apart = float(np.median(np.where(gaps > 1e-6, gaps, np.inf).min(axis=1)))
    about = apart / 2 if math.isfinite(apart) else 0.0
    low = cells.min(axis=0) - about - CELL
    size = np.ceil((cells.max(axis=0) + about + CELL - low) / CELL).astype(int)
    far = np.ones(size[::-1], np.uint8)
    column, row = np.floor((cells - low) / CELL).astype(int).T
    far[row, column] = 0
    off = cv2.distanceTransform(far, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL
    return FloorMap((float(low[0]), float(low[1])), off <= about)


def _stand(pose: np.ndarray, cells: np.ndarray, headings: np.ndarray | None) -> None:
    """Move a pose [4] to the nearest cell where a robot may stand, and to a heading there."""
    gap = np.hypot(*(cells - pose[:2]).T)
    near = np.flatnonzero(gap <= gap.min() + 1e-6)
    best = near[0]
    if headings is not None:
        best = near[np.argmin(tasks.heading_error(headings[near], pose[2]))]
        pose[2] = headings[best]
    pose[:2] = cells[best]
