"""Scenes on the command line: `--scene`, its short forms for houses, and splits."""

from __future__ import annotations

import argparse

from vn_nav.errors import UserError
from vn_nav.scenes import (
    HOUSE,
    ROOMS,
    house_scene,
    house_scenes,
    parse_scene,
    rooms_of,
    scene_name,
)

OWN_SPLITS = ('seen_goals', 'unseen_goals')  # in the scenes of a checkpoint's training
SPLIT_SCENES = 20  # of a split that the checkpoint does not know, by default
UNSEEN_GOALS = 1  # `EnvConfig.goal_seed` of goals that no training shows (its own is 0)


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Where."""
    parser.add_argument('--scene', action='append', metavar='NAME', help='house:7, '
                        'house:7?rooms=3, bag:my_drive, ... (vn_nav simulators); may be given '
                        'several times')


def scenes_from(args: argparse.Namespace, rooms: int | None = None) -> list[str]:
    """The scenes that are named by --scene, or by --house and --rooms; each once.

    Args:
        args: with these options.
        rooms: of a house where --rooms is not given.

    Raises:
        UserError: both ways, or no scene's name.
    """
    if args.scene and (args.house or args.rooms is not None):
        raise UserError('scenes are named by --scene, or houses by --house and --rooms',
                        '--scene and ' + ('--house' if args.house else '--rooms'),
                        'give one of them')
    named = [scene_name(scene) for scene in args.scene or ()]
    houses = house_scenes(args.house or (), args.rooms or rooms or ROOMS)
    return list(dict.fromkeys([*named, *houses]))


def training_scenes(args: argparse.Namespace) -> list[str]:
    """The scenes of a training: named ones, or the first N training houses; one if none is asked.

    Raises:
        UserError: both.
    """
    if (args.house or args.scene) and args.houses:
        raise UserError('scenes are named, or the first N training houses',
                        '--scene or --house, and --houses', 'give one of them')
    count = 1 if args.houses is None else max(args.houses, 0)
    return scenes_from(args) or split_scenes(HOUSE, 'train', count, args.rooms)


def split_scenes(simulator: str, split: str, count: int | None, rooms: int | None = None
                 ) -> list[str]:
    """Names of the first scenes of a split.

    Args:
        simulator: whose split.
        split: its name.
        count: at most so many; None: all.
        rooms: of houses.

    Raises:
        UserError: a split that the simulator does not have.
    """
    from vn_sim_bridge.simulators import simulator_class
    splits = simulator_class(simulator).splits
    if split not in splits:
        raise UserError(f'a split is one of {", ".join([*splits, *OWN_SPLITS])}',
                        split, 'choose one of them')
    found = list(splits[split][:count])
    if rooms not in (None, ROOMS):
        if simulator != HOUSE:
            raise UserError('rooms are a number of houses', f'--rooms {rooms} with {simulator}',
                            'leave it out')
        found = [scene_name(f'{scene}?rooms={rooms}') for scene in found]
    return found


def checkpoint_scenes(info: dict, split: str, count: int | None = None,
                      rooms: int | None = None) -> list[str]:
    """The scenes of a split, to measure a checkpoint in.

    Args:
        info: of the checkpoint.
        split: its name, or one of `OWN_SPLITS`.
        count: at most so many; None: all of its own, `SPLIT_SCENES` others.
        rooms: of houses; None: as of those that it was trained in.

    Raises:
        UserError: no such split; or the checkpoint was trained in it, or, where its own scenes
            are asked for, names none.
    """
    if split in OWN_SPLITS:
        own = list(info['scenes'][:count])
        if not own:
            raise UserError('seen and unseen goals are in the scenes of the checkpoint',
                            'a checkpoint that names none',
                            'give --scene, --house or another --split')
        return own if not rooms else list(dict.fromkeys(
            house_scene(int(parse_scene(scene).place), rooms) for scene in own))
    if rooms is None and info['simulator'] == HOUSE and info['scenes']:
        rooms = rooms_of(info['scenes'][0])
    found = split_scenes(info['simulator'], split, count or SPLIT_SCENES, rooms)
    known = [scene for scene in found if scene in info['scenes']]
    if split != 'train' and known:
        raise UserError(f'the checkpoint was not trained in scenes of split {split}', known[0],
                        'choose another split')
    return found
