"""The task of a configuration, in the places of a simulator."""

from __future__ import annotations

from collections.abc import Sequence

from vn_sim_bridge.floor.places import with_rooms
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.env_config import EnvConfig, objects_of
from vn_sim_bridge.navigation.own_objects import OwnObjectGoal
from vn_sim_bridge.simulator import Simulator


def make_task(config: EnvConfig, simulator: Simulator, label_names: Sequence[str]) -> tasks.Task:
    """What robots are to do.

    Args:
        config: names the task.
        simulator: where; `check_simulator` has found that it can.
        label_names: behind its class ids.
    """
    places, distance = list(simulator.places), config.min_start_distance
    if config.task == 'image':
        return tasks.ImageGoal(places, config.num_envs, min_distance=distance,
                               fixed_goals=config.one_goal_per_env)
    if config.task == 'object' and simulator.capabilities.own_objects:
        return OwnObjectGoal(places, simulator.scatter, min_distance=distance)
    models = objects_of(simulator, config.task)
    if config.task == 'object':
        return tasks.ObjectGoal(
            places, config.num_envs, models=models, objects=config.objects,
            pictures=max(4, config.pictures_per_goal), min_distance=distance, seed=config.seed)
    if config.task == 'room':
        return tasks.RoomGoal(list(map(with_rooms, places)), config.num_envs,
                              must_see=config.room_must_see, min_distance=distance,
                              label_names=label_names, room_objects=simulator.room_objects)
    return tasks.Collect(places, config.num_envs, models=models, objects=config.objects)
