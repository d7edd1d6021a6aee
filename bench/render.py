"""Frames per second of the CPU renderer (RGB + depth + labels) compared with other simulators.

Everything is measured in one run, in turns, pinned to one core (two where it says so). The peers
live in an environment of their own, see bench/requirements.txt; without it their rows are left
out.

    python bench/render.py [--peers runs/peers/bin/python]
"""

import argparse
import dataclasses
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from common import ROUNDS, frames_per_second, pin, random_cameras, report

from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.houses.textures import TEXTURES, texture_library
from vn_sim_bridge.render.pack import Lights
from vn_sim_bridge.render.randomisation import draw_appearance, load_randomisation
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.scene import Scene, SceneBuilder
from vn_sim_bridge.render.sensor import expose

POSES, BATCH = 64, 16
FOV = math.radians(90)
DIFFERENT_SCENES = {'ViZDoom': 'my_way_home, 160 x 120 (its smallest), RGB + depth + labels',
                    'EnvPool': 'MyWayHome at 84 x 84, RGB, one environment, frame skip 1',
                    'MiniWorld': 'FourRooms at 84 x 84, RGB + depth (it has no labels)',
                    'MiniWorld, RGB alone': 'FourRooms at 84 x 84',
                    'MuJoCo': 'our own house, exported, 84 x 84, RGB + depth + segmentation'}


def box_house(house) -> Scene:
    """The same floor plan with every piece of furniture as one box, and no baked light."""
    source, builder = house.scene, SceneBuilder(texture_library())
    shell = [LABELS.index(name) for name in ('wall', 'floor', 'ceiling', 'door')]
    for k in range(len(source.group_room)):
        for face in range(source.group_start[k], source.group_start[k + 1]):
            if source.face_label[face] in shell:
                points = source.vertices[source.face_start[face]:source.face_start[face + 1]]
                builder.polygon(points, texture=int(source.face_texture[face]),
                                colour=source.face_colour[face],
                                label=int(source.face_label[face]),
                                instance=int(source.face_instance[face]))
        builder.end_group()
    rng = np.random.default_rng(0)
    for number, obstacle in enumerate(house.obstacles):
        if obstacle.label in ('wall', 'outside'):
            continue
        (x0, y0, x1, y1), z = obstacle.rect, rng.uniform(0.5, 1.8)
        sides = ([(x0, y0, 0), (x1, y0, 0), (x1, y0, z), (x0, y0, z)],
                 [(x1, y0, 0), (x1, y1, 0), (x1, y1, z), (x1, y0, z)],
                 [(x1, y1, 0), (x0, y1, 0), (x0, y1, z), (x1, y1, z)],
                 [(x0, y1, 0), (x0, y0, 0), (x0, y0, z), (x0, y1, z)],
                 [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)])
        for side in sides:
            builder.polygon(side, texture=TEXTURES['wood'], colour=rng.uniform(0.3, 0.9, 3),
                            label=LABELS.index('box'), instance=1000 + number)
        builder.end_group()
    return builder.build()


def city(scene: Scene, triangles: int, spacing: float) -> Scene:
    """Copies of a house side by side, about so many triangles in all."""
    count = max(1, round(triangles / scene.triangle_count))
    side = math.ceil(math.sqrt(count))
    shifts = np.array([(i % side * spacing, i // side * spacing, 0) for i in range(count)],
                      np.float32)
    plane = np.tile(scene.face_plane, (count, 1, 1)).copy()
    plane[..., 3] += np.einsum('fk,ck->cf', scene.face_plane[:, :3], shifts)
    uv = np.tile(scene.face_uv, (count, 1, 1, 1)).copy()
    uv[..., 3] -= np.einsum('fkd,cd->cfk', scene.face_uv[..., :3], shifts)
    box = scene.group_box[None] + np.concatenate([shifts, shifts], axis=1)[:, None]

    def stack(values, base):
        steps = np.arange(count).reshape(-1, *[1] * values.ndim) * base
        return (values[None] + steps).reshape(-1, *values.shape[1:])
    faces, corners = len(scene.face_label), len(scene.face_vertices)
    return dataclasses.replace(
        scene, vertices=(scene.vertices[None] + shifts[:, None]).reshape(-1, 3),
        face_start=np.append(stack(scene.face_start[:-1], corners), count * corners),
        face_vertices=stack(scene.face_vertices, len(scene.vertices)),
        face_plane=plane.reshape(-1, 4), face_uv=uv.reshape(-1, 2, 4),
        group_start=np.append(stack(scene.group_start[:-1], faces), count * faces),
        group_box=box.reshape(-1, 6),
        **{name: np.concatenate([getattr(scene, name)] * count) for name in (
            'face_texture', 'face_colour', 'face_label', 'face_instance', 'face_light',
            'face_light_map', 'group_room')})


def subdivided(scene: Scene, triangles: int) -> Scene:
    """The same surfaces in about so many triangles, all of which can be seen."""
    from vn_sim_bridge.houses.mesh import load_mesh
    from vn_sim_bridge.houses.mesh_export import export_mesh
    with tempfile.TemporaryDirectory() as folder:
        import trimesh
        path = Path(folder) / 'house.glb'
        export_mesh(scene, path)
        loaded = trimesh.load_scene(path, process=False)
        total = sum(len(g.faces) for g in loaded.geometry.values())
        limit = 1.0
        while total < triangles:
            limit *= 0.8
            parts = {}
            for name, mesh in loaded.geometry.items():
                points, faces, index = trimesh.remesh.subdivide_to_size(
                    mesh.vertices, mesh.faces, limit, max_iter=20, return_index=True)
                uv = mesh.visual.uv[mesh.faces[index]]  # good enough to be drawn
                corners = points[faces].reshape(-1, 3)
                parts[name] = (corners, uv.reshape(-1, 2))
            total = sum(len(corners) // 3 for corners, _ in parts.values())
        if limit < 1.0:
            out = trimesh.Scene()
            for name, (corners, uv) in parts.items():
                visual = trimesh.visual.TextureVisuals(uv, loaded.geometry[name].visual.material)
                out.add_geometry(trimesh.Trimesh(
                    corners, np.arange(len(corners)).reshape(-1, 3), visual=visual,
                    process=False), node_name=name, geom_name=name)
            path.write_bytes(out.export(file_type='glb'))
        return load_mesh(path)


class Peers:
    """The other simulators, in a process of their own."""

    def __init__(self, python: Path, house):
        scene = house.scene
        self.file = tempfile.NamedTemporaryFile(suffix='.npz')
        np.savez(self.file.name, vertices=scene.vertices, starts=scene.face_start,
                 groups=scene.group_start, cameras=random_cameras(house, POSES),
                 colours=scene.face_colour[scene.group_start[:-1]])
        self.process = subprocess.Popen(
            [python.absolute(), Path(__file__).absolute().with_name('peers.py'), self.file.name],
            text=True, cwd=tempfile.gettempdir(),  # ViZDoom leaves a file where it runs
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        ready = json.loads(self.process.stdout.readline())
        for name, reason in ready['missing'].items():
            print(f'bench/render.py: no {name}: {reason}', file=sys.stderr)
        self.names = [name for name in DIFFERENT_SCENES if name in ready['ready']]

    def measure(self) -> dict:
        """Frames a second of each."""
        self.process.stdin.write('measure\n')
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


def main():
    """Measure in turns, then print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--house', type=int, default=7)
    parser.add_argument('--rounds', type=int, default=ROUNDS)
    parser.add_argument('--peers', type=Path, default=Path('runs/peers/bin/python'))
    arguments = parser.parse_args()
    pin(1)
    house = generate_house(arguments.house, rooms=6)
    cameras = random_cameras(house, POSES)
    varied = load_randomisation('standard')
    effects = load_randomisation('rough')
    rows = {}

    def row(name, scene, size, threads=1, look=None, sensor=False):
        renderer = Rasterizer([scene], size, threads=threads)
        options = {}
        if look is not None:
            options['lights'] = Lights(look.cube, look.lamps)
        batch = BATCH if threads == 1 else POSES
        index = np.zeros(batch, int)
        out = renderer.render(index, cameras[:batch], FOV, **options)
        keys = key(0, Stream.SENSOR, np.arange(batch), 0)

        def draw():
            for first in range(0, POSES, batch):
                renderer.render(index, cameras[first:first + batch], FOV, out, **options)
                if sensor:
                    expose(out[0], look.noise, look.blur, keys)
        draw()
        rows[name] = (draw, threads, f'{size} x {size}, {threads} thread(s), batch {batch}, '
                      f'{scene.triangle_count} triangles')

    scene, rooms = house.scene, 1 + int(house.scene.group_room.max())

    def look(config):
        return draw_appearance(config, rooms, 0, Stream.APPEARANCE, np.arange(BATCH), 0)
    row('house', scene, 84)
    row('house, 174', scene, 174)
    row('house, two threads', scene, 84, threads=2)
    row('house, 174, two threads', scene, 174, threads=2)
    row('house, randomised light', scene, 84, look=look(varied))
    row('house, noise and blur', scene, 84, look=look(effects), sensor=True)
    row('plain box house', box_house(house), 84)
    for triangles in (10_000, 100_000, 1_000_000):
        row(f'{triangles:,} triangles, spread out', city(scene, triangles, 25.0), 84)
        row(f'{triangles:,} triangles, in sight', subdivided(scene, triangles), 84)
    peers = Peers(arguments.peers, house) if arguments.peers.exists() else None
    if peers is None:
        print(f'bench/render.py: no peers ({arguments.peers}, see bench/requirements.txt)',
              file=sys.stderr)
    values = {name: [] for name in rows}
    others = {name: [] for name in (peers.names if peers else [])}
    for _ in range(arguments.rounds):
        for name, (draw, threads, _) in rows.items():
            os.sched_setaffinity(0, range(os.cpu_count()))
            pin(threads)
            values[name].append(frames_per_second(draw, POSES))
        if peers:
            for name, value in peers.measure().items():
                others[name].append(value)
    base = values['house']
    for name, (_, _, conditions) in rows.items():
        peer = None if name == 'house' else 'house'
        report(f'renderer: {name}', values[name], conditions, peer=peer, peer_values=base)
    for name in others:
        report('renderer: house', base, f'{rows["house"][2]}; {name}: {DIFFERENT_SCENES[name]}',
               peer=name, peer_values=others[name])


if __name__ == '__main__':
    main()
