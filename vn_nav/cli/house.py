"""`vn_nav house`: look at an embedded house, or at another scene."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from vn_nav.scenes import house_scene, scene_name


def add_options(parser: argparse.ArgumentParser) -> None:
    """The actions of `vn_nav house`."""
    actions = parser.add_subparsers(dest='action', required=True, metavar='ACTION')
    for name, about, run, out in (
            ('show', 'write a contact sheet: views and a map', _show, 'png'),
            ('walk', 'drive with the keyboard', _walk, None),
            ('export', 'write a mesh that other programs open', _export, 'glb')):
        action = actions.add_parser(name, help=about)
        action.add_argument('--seed', type=int, default=7)
        action.add_argument('--rooms', type=int, default=5)
        if name != 'export':
            action.add_argument('--scene', metavar='NAME', help='another scene, of any simulator')
            action.add_argument('--randomisation', default='none' if out else 'standard',
                                metavar='NAME', help='of light and camera: none, standard, rough, '
                                'harsh or a YAML file')
        if out:
            action.add_argument('--out', type=Path, help=f'file (default house-SEED.{out})')
        if name == 'export':
            action.add_argument('--suncg', type=Path, metavar='DIR', help="write it in SUNCG's "
                                'format into this folder instead (simulator suncg)')
            action.add_argument('--house3d', action='store_true', help='with --suncg: also the '
                                'house.obj that House3D reads')
        action.set_defaults(run=run)


def _show(args: argparse.Namespace) -> int:
    """`vn_nav house show`."""
    from vn_sim_bridge.render.randomisation import load_randomisation
    from vn_sim_bridge.tools.contact_sheet import write_contact_sheet
    scene = _scene(args)
    path = args.out or Path(f'house-{args.seed}.png' if args.scene is None else (
        re.sub(r'\W+', '-', scene) + '.png'))
    write_contact_sheet(path, scene, load_randomisation(args.randomisation))
    if args.scene is not None:
        print(path)
        return 0
    from vn_sim_bridge.houses.procedural import generate_house
    house = generate_house(args.seed, rooms=args.rooms)
    print(f'{path}: {len(house.rooms)} rooms, {house.area:.0f} m2, '
          f'{house.scene.triangle_count} triangles, goals in '
          f'{", ".join(goal.room for goal in house.goals)}')
    return 0


def _walk(args: argparse.Namespace) -> int:
    """`vn_nav house walk`."""
    from vn_sim_bridge.render.randomisation import load_randomisation
    from vn_sim_bridge.tools.walk import walk
    walk(_scene(args), load_randomisation(args.randomisation))
    return 0


def _scene(args: argparse.Namespace) -> str:
    """The scene that is asked for."""
    return scene_name(args.scene) if args.scene else house_scene(args.seed, args.rooms)


def _export(args: argparse.Namespace) -> int:
    """`vn_nav house export`."""
    from vn_sim_bridge.houses.mesh_export import export_mesh
    from vn_sim_bridge.houses.procedural import generate_house
    house = generate_house(args.seed, rooms=args.rooms)
    if args.suncg is not None:
        from vn_sim_bridge.suncg.export import export_suncg
        name = export_suncg(house, args.suncg, converted=args.house3d)
        print(f'{args.suncg}: house {name}, {len(house.rooms)} rooms; '
              f'export SUNCG_PATH={args.suncg}, scene suncg:{name}')
        return 0
    path = args.out or Path(f'house-{args.seed}.glb')
    export_mesh(house.scene, path)
    print(f'{path}: {house.scene.triangle_count} triangles, {path.stat().st_size / 1e6:.1f} MB, '
          'parts named by class and instance')
    return 0
