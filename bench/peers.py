"""Frame rates of other simulators, for the side-by-side run of bench/render.py.

Runs in an environment of its own (bench/requirements.txt), receives on standard input when to
measure, and answers one JSON line each time: {"peer": frames per second, ...}.
"""

import argparse
import contextlib
import json
import math
import os
import sys
import time
import xml.etree.ElementTree as ElementTree

import numpy as np

SECONDS = 0.8  # of a measurement


def rate(step) -> float:
    """Calls of `step` a second."""
    begun, count = time.perf_counter(), 0
    while (spent := time.perf_counter() - begun) < SECONDS:
        step()
        count += 1
    return count / spent


def vizdoom_step():
    """One frame of my_way_home at its smallest resolution: RGB, depth and labels."""
    import vizdoom
    game = vizdoom.DoomGame()
    game.load_config(os.path.join(vizdoom.scenarios_path, 'my_way_home.cfg'))
    game.set_screen_resolution(vizdoom.ScreenResolution.RES_160X120)
    game.set_screen_format(vizdoom.ScreenFormat.CRCGCB)
    game.set_depth_buffer_enabled(True)
    game.set_labels_buffer_enabled(True)
    game.set_window_visible(False)
    game.init()
    actions = np.eye(game.get_available_buttons_size(), dtype=int).tolist()
    rng = np.random.default_rng(0)

    def step():
        game.make_action(actions[rng.integers(len(actions))], 1)
        if game.is_episode_finished():
            game.new_episode()
        state = game.get_state()
        return state.screen_buffer, state.depth_buffer, state.labels_buffer
    return step


def envpool_step():
    """One frame of EnvPool's MyWayHome: one environment, RGB only, frame skip 1."""
    import envpool
    env = envpool.make('MyWayHome-v1', env_type='gymnasium', num_envs=1, frame_skip=1,
                       stack_num=1, img_width=84, img_height=84, num_threads=1)
    env.reset()
    actions = [env.action_space.sample()[None] for _ in range(64)]
    turn = iter(range(1 << 62))
    return lambda: env.step(actions[next(turn) % 64])


def miniworld_step(depth: bool):
    """One frame of FourRooms at 84 x 84: RGB, and depth if asked for."""
    os.environ.setdefault('PYGLET_HEADLESS', '1')
    import pyglet
    pyglet.options['headless'] = True
    import gymnasium
    import miniworld  # noqa: F401 (registers its environments)
    env = gymnasium.make('MiniWorld-FourRooms-v0', obs_width=84, obs_height=84)
    env.reset(seed=0)
    rng = np.random.default_rng(0)

    def step():
        _, _, terminated, truncated, _ = env.step(int(rng.integers(0, 3)))
        if terminated or truncated:
            env.reset()
        if depth:
            env.unwrapped.render_depth(env.unwrapped.obs_fb)
    return step


def mujoco_step(scene: str):
    """One frame of our own exported house at 84 x 84: RGB, depth and segmentation."""
    import mujoco
    with np.load(scene) as data:
        vertices, starts = data['vertices'], data['starts']
        groups, colours, cameras = data['groups'], data['colours'], data['cameras']
    root = ElementTree.Element('mujoco')
    ElementTree.SubElement(ElementTree.SubElement(root, 'visual'), 'global',
                           offwidth='84', offheight='84', fovy='90')
    asset = ElementTree.SubElement(root, 'asset')
    body = ElementTree.SubElement(root, 'worldbody')
    ElementTree.SubElement(body, 'light', pos='0 0 2.5', directional='true')
    for k in range(len(groups) - 1):
        points, faces = [], []
        for face in range(groups[k], groups[k + 1]):
            first = len(points)
            points += vertices[starts[face]:starts[face + 1]].tolist()
            faces += [(first, first + i, first + i + 1)
                      for i in range(1, starts[face + 1] - starts[face] - 1)]
        if len(np.unique(np.round(points, 6), axis=0)) < 4 or np.ptp(points, axis=0).min() < 1e-4:
            points = np.array(points)
            flat = int(np.argmin(np.ptp(points, axis=0)))  # MuJoCo wants volume: a hair of it
            extra = points[:1].copy()
            extra[0, flat] += 0.001
            points = np.concatenate([points, extra]).tolist()
        ElementTree.SubElement(asset, 'mesh', name=f'm{k}', inertia='shell', vertex=' '.join(
            f'{v:.5f}' for p in points for v in p), face=' '.join(
                str(i) for f in faces for i in f))
        red, green, blue = colours[k]
        ElementTree.SubElement(body, 'geom', type='mesh', mesh=f'm{k}', contype='0',
                               conaffinity='0', rgba=f'{red:.3f} {green:.3f} {blue:.3f} 1')
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding='unicode'))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, 84, 84)
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    count = [0]

    def step():
        x, y, z, yaw, _ = cameras[count[0] % len(cameras)]
        count[0] += 1
        camera.azimuth, camera.elevation, camera.distance = math.degrees(yaw), 0.0, 0.01
        camera.lookat[:] = (x, y, z)
        renderer.update_scene(data, camera)
        renderer.render()
        renderer.enable_depth_rendering()
        renderer.render()
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        renderer.render()
        renderer.disable_segmentation_rendering()
    return step


def main():
    """Set up every peer that can be, then measure in turn whenever asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('scene', help='.npz of our house, for MuJoCo')
    scene = parser.parse_args().scene
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # what the peers print goes elsewhere
    makers = {'ViZDoom': vizdoom_step, 'EnvPool': envpool_step,
              'MiniWorld': lambda: miniworld_step(True),
              'MiniWorld, RGB alone': lambda: miniworld_step(False),
              'MuJoCo': lambda: mujoco_step(scene)}
    steps, missing = {}, {}
    for name, make in makers.items():
        try:
            step = make()
            step()
            steps[name] = step
        except Exception as error:  # whatever keeps a peer from running is its row's content
            missing[name] = f'{type(error).__name__}: {error}'.splitlines()[0][:120]
    print(json.dumps({'ready': sorted(steps), 'missing': missing}), file=answers, flush=True)
    for line in sys.stdin:
        if line.strip() != 'measure':
            break
        with contextlib.suppress(BrokenPipeError):
            print(json.dumps({name: rate(step) for name, step in steps.items()}), file=answers,
                  flush=True)


if __name__ == '__main__':
    main()
