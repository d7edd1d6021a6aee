"""`NavigationEnv`'s image-goal task on a Warp device: nothing leaves the GPU (`vn_nav[gpu]`).

Motion, collisions, rewards, new episodes and pictures are kernels (`warp_decisions`,
`render.warp_renderer`); actions come and observations go as PyTorch tensors that share the
device's memory. The same seeds give the same episodes as `NavigationEnv` does: the formulas and
the counter of the random numbers are the same.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from vn_nav.co_visibility import GRID, lift
from vn_nav.errors import UserError
from vn_nav.reset_arguments import are_several, read_options, read_seed
from vn_nav.robot import RobotSpec
from vn_nav.scenes import HOUSE, one_simulator
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.env_config import EnvConfig, not_on_device
from vn_sim_bridge.navigation.warp_decisions import decide, restart, share_in_view
from vn_sim_bridge.navigation.warp_state import (
    MODES,
    NOT_STATE,
    Robots,
    make_robots,
    make_rules,
    put,
    upload_houses,
    variables,
)
from vn_sim_bridge.render.randomisation import draw_appearance
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.render.warp_renderer import WarpRenderer
from vn_sim_bridge.simulators.house import WORLD_VERSION, open_houses


class WarpNavigationEnv:
    """Image-goal navigation on one device; see `NavigationEnv` for what it simulates.

    `reset` and `step` return the same dicts as `NavigationEnv` does, of tensors that live on the
    device and change in place with the next step. They work on the stream that is PyTorch's at
    construction, so that neither waits for the other. `goals` and `goal_segmentation` are tensors
    as well.

    Args:
        config: task 'image', and what else `not_on_device` asks for.
        robot: the standard robot if left out.
        device: Warp device, such as 'cuda:0' or 'cpu'.
    """

    def __init__(self, config: EnvConfig | None = None, robot: RobotSpec | None = None, *,
                 device: str = 'cuda:0'):
        self.config = config = config or EnvConfig()
        if refusal := not_on_device(config):
            raise refusal
        _, scenes = one_simulator(config.scenes)
        self.robot = (robot or RobotSpec()).with_actions(config.actions)
        self.num_envs, self.device = config.num_envs, device
        if wp.get_device(device).is_cuda:
            wp.set_stream(wp.stream_from_torch(wp.device_to_torch(device)), device)
        self.world_version, self.action_names = WORLD_VERSION, self.robot.action_names
        self.simulator_name, self.label_names = HOUSE, LABELS
        self.places = open_houses(scenes, config.goals_per_room, config.goal_seed)
        if self.robot.footprint_radius > min(h.footprint_radius for h in self.places):
            raise UserError('the robot fits into the floor map of the house',
                            self.robot.footprint_radius, 'use a smaller robot')
        task = tasks.ImageGoal(self.places, self.num_envs, min_distance=config.min_start_distance)
        self.goal_rooms = tuple(view.name for view in task.views)
        self.goal_poses = np.array([view.pose for view in task.views])
        scenes_3d = [house.scene for house in self.places]
        self.renderer = WarpRenderer(scenes_3d, config.size, self.num_envs, device=device)
        self._houses = upload_houses(self.places, task, device)
        self._rules = make_rules(config, self.robot, len(self.places), len(self.goal_poses),
                                 device)
        self._robots = make_robots(self.num_envs, len(self.places), self.renderer.rooms, device)
        self._deltas = self._put([[a.dx, a.dy, a.dyaw, a.dpitch] for a in self.robot.actions],
                                 np.float64)
        self._no_objects = (self._put(np.zeros((self.num_envs, 0)), np.int64),
                            self._put(np.zeros((self.num_envs, 0, 4)), np.float64),
                            self._put(np.zeros((self.num_envs, 0)), np.int64))
        self._co_visible = wp.zeros(self.num_envs, dtype=wp.float32, device=device)
        self._draw_goals(task, scenes_3d)
        self._state = {name: wp.to_torch(getattr(self._robots, name))
                       for name in variables(Robots) if name not in NOT_STATE}
        self._drawn = {name: wp.to_torch(getattr(self.renderer, name))
                       for name in ('rgb', 'depth', 'labels')}
        self._in_view = wp.to_torch(self._co_visible)

    def _put(self, values, dtype) -> wp.array:
        return put(values, dtype, self.device)

    def _draw_goals(self, task: tasks.ImageGoal, scenes: Sequence[Scene]) -> None:
        """Every goal's pictures, in the lights that `NavigationEnv` shows them in."""
        varied, size, variants = self.config.of_goals, self.config.size, self._rules.variants
        goal = np.repeat(np.arange(len(task.views)), variants)
        variant = np.tile(np.arange(variants), len(task.views))
        appearance = draw_appearance(varied, self.renderer.rooms, self.config.seed,
                                     Stream.GOAL_APPEARANCE, goal, variant)
        poses = self.goal_poses[goal]
        cameras = np.column_stack([
            poses[:, :2], self.robot.camera_height + appearance.height, poses[:, 2],
            poses[:, 3] + self.robot.camera_pitch + appearance.pitch])
        focal = size / 2 / np.tan((self.robot.camera_fov + appearance.fov) / 2)
        renderer = WarpRenderer(scenes, size, len(goal), device=self.device)
        no_objects = np.zeros((len(goal), 0))
        sensor = {}
        if varied.noise[1] > 0 or varied.blur[1] > 0:
            sensor = {'noise': self._put(appearance.noise, np.float32),
                      'blur': self._put(appearance.blur, np.float32),
                      'keys': self._put(key(self.config.seed, Stream.GOAL_APPEARANCE, goal,
                                            variant, 99), np.uint64)}
        renderer.render(
            self._put([task.views[k].place for k in goal], np.int64),
            self._put(cameras, np.float64), self._put(focal, np.float64),
            self._put(appearance.cube, np.float32), self._put(appearance.lamps, np.float32),
            object_scene=self._put(no_objects, np.int64),
            object_pose=self._put(np.zeros((len(goal), 0, 4)), np.float64),
            object_room=self._put(no_objects, np.int64), **sensor)
        grey = torch.full((1, 3, size, size), 128, dtype=torch.uint8,
                          device=wp.device_to_torch(self.device))
        self.goals = torch.cat([wp.to_torch(renderer.rgb), grey])
        self.goal_segmentation = torch.cat([wp.to_torch(renderer.labels),
                                            torch.zeros_like(grey[:, 0])])
        self.blank_goal = len(goal)
        if 'overlap' in self.config.privileged:
            points = lift(renderer.depth.numpy(), cameras, self.robot.camera_fov + appearance.fov)
            nowhere = np.full((1, GRID * GRID, 3), np.nan)
            self._goal_points = self._put(np.concatenate([points, nowhere]), np.float32)

    def set_difficulty(self, tau: float) -> None:
        """As `NavigationEnv.set_difficulty`."""
        if not 0 < tau <= 1:
            raise UserError('the difficulty tau lies in (0, 1]', tau, 'choose a value in range')
        self._rules.difficulty = float(tau)

    def set_shown_goal(self, mode: str) -> None:
        """As `NavigationEnv.set_shown_goal`."""
        if mode not in MODES:
            raise UserError('the shown goal is right, wrong or blank', mode, 'choose one of them')
        if mode == tasks.WRONG and min(len(house.goals) for house in self.places) < 2:
            raise UserError('a wrong goal needs a place with at least two goals',
                            ', '.join(self.config.scenes), 'use larger scenes')
        self._rules.mode = MODES[mode]

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start a new episode everywhere; a seed also restarts the count of episodes.

        Raises:
            UserError: a list of seeds, or a `reset_mask`, which `NavigationEnv` knows.
        """
        if 'reset_mask' in read_options(options, ('reset_mask',)) or are_several(seed):
            raise UserError('on a GPU all environments begin together, by one seed',
                            seed if options is None else options, 'use NavigationEnv')
        seed = read_seed(seed)
        if seed is not None:
            self._rules.seed = seed
            self._robots.episode.fill_(-1)
        wp.launch(restart, self.num_envs, [self._houses, self._robots, self._rules],
                  device=self.device)
        return self._observe()

    def step(self, actions: torch.Tensor):
        """One decision in every environment that is not being reset.

        Args:
            actions: [N] int64 on the device; they are not checked there: keep them in range.
        """
        if actions.shape != (self.num_envs,) or actions.dtype != torch.int64:
            raise UserError(f'actions are {self.num_envs} 64-bit integers',
                            (tuple(actions.shape), actions.dtype), 'pass such a tensor')
        wp.launch(decide, self.num_envs, [self._houses, self._robots, self._rules, self._deltas,
                                          wp.from_torch(actions.contiguous())],
                  device=self.device)
        observation, info = self._observe()
        state = self._state
        return observation, state['reward'], state['terminated'], state['truncated'], info

    @property
    def place_index(self) -> torch.Tensor:
        """[N] the house of each robot."""
        return self._state['house']

    restorable = True  # see `NavigationEnv.restorable`
    distance_unit = 'm'  # see `NavigationEnv.distance_unit`

    def close(self) -> None:
        """The arrays go with this object: there is nothing else to release."""

    def get_state(self) -> dict[str, np.ndarray]:
        """As `NavigationEnv.get_state`; this waits for the device."""
        return {'seed': np.array(self._rules.seed),
                **{name: rows.cpu().numpy().copy() for name, rows in self._state.items()}}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Go on from what `get_state` returned."""
        self._rules.seed = int(state['seed'])
        for name, rows in self._state.items():
            rows.copy_(torch.from_numpy(state[name]))

    def _observe(self):
        robots, varied, state = self._robots, self.config.randomisation, self._state
        sensor = {}
        if varied.noise[1] > 0 or varied.blur[1] > 0:
            sensor = {'noise': robots.noise, 'blur': robots.blur, 'keys': robots.sensor_key}
        scene, pose, room = self._no_objects
        self.renderer.render(robots.house, robots.camera, robots.focal, robots.cube, robots.lamps,
                             object_scene=scene, object_pose=pose, object_room=room, **sensor)
        observation = {
            'image': self._drawn['rgb'],
            'goal_index': state['shown'],
            'last_action': state['last_action'],
            'last_reward': state['last_reward'],
        }
        info = {
            'reset': state['reset'],
            'success': state['terminated'],
            'arrived': state['arrived'],
            'collided': state['collided'],
            **{name: state[name].float()
               for name in ('distance', 'heading_error', 'start_distance', 'path_length')},
            'decisions': state['step'],
            'goal': state['goal'],
            'pose': state['pose'],
            'depth': self._drawn['depth'],
            'segmentation': self._drawn['labels'],
        }
        wanted = self.config.privileged
        if 'goal_segmentation' in wanted:
            info['goal_segmentation'] = self.goal_segmentation[state['shown']]
        if 'goal_pose' in wanted:
            info['goal_pose'] = state['goal_pose']
        if 'overlap' in wanted:
            wp.launch(share_in_view, self.num_envs, [
                self._goal_points, robots.picture, self.renderer.depth, robots.camera,
                robots.focal, self._co_visible], device=self.device)
            info['overlap'] = self._in_view
        return observation, info
