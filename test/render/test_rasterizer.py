"""The renderer against a brute-force ray caster, and its promises."""

import dataclasses
import math

import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.objects import object_scene
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.houses.textures import TEXTURES, texture_library
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.scene import SceneBuilder, as_labels
from vn_sim_bridge.simulator import Objects

FOV = math.radians(90)


@pytest.fixture(scope='module')
def house():
    return generate_house(7, rooms=6)


def cameras(house, count, seed=0, tilt=0.0):
    rng = np.random.default_rng(seed)
    cells = house.floor.centres()
    xy = cells[rng.integers(len(cells), size=count)]
    return np.column_stack([xy, np.full(count, 1.0), rng.uniform(-math.pi, math.pi, count),
                            rng.uniform(-tilt, tilt, count)])


def ray_cast(scene, camera, size, fov):
    """Depth and label of every pixel by intersecting its ray with every polygon."""
    focal = size / 2 / math.tan(fov / 2)
    cy, sy, cp, sp = (math.cos(camera[3]), math.sin(camera[3]), math.cos(camera[4]),
                      math.sin(camera[4]))
    forward, right = np.array([cp * cy, cp * sy, -sp]), np.array([sy, -cy, 0.0])
    down = np.array([-sp * cy, -sp * sy, -cp])
    pixel = (np.arange(size) + 0.5 - size / 2) / focal
    rays = (forward + pixel[None, :, None] * right + pixel[:, None, None] * down).reshape(-1, 3)
    depth, label = np.full(len(rays), np.inf), np.zeros(len(rays), int)
    for face in range(len(scene.face_label)):
        normal, offset = scene.face_plane[face, :3].astype(float), float(scene.face_plane[face, 3])
        height = normal @ camera[:3] - offset
        if height <= 0:
            continue
        with np.errstate(divide='ignore', invalid='ignore'):
            t = -height / (rays @ normal)
        points = camera[:3] + t[:, None] * rays
        corners = scene.vertices[scene.face_start[face]:scene.face_start[face + 1]].astype(float)
        inside = np.isfinite(t) & (t > 0.03)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            inside &= np.cross(b - a, points - a) @ normal >= 0
        hit = inside & (t < depth)
        depth[hit], label[hit] = t[hit], scene.face_label[face]
    return depth.reshape(size, size), label.reshape(size, size)


def test_depth_and_labels_agree_with_ray_casting(house):
    views = cameras(house, 4, tilt=0.5)
    _, depth, labels, _ = Rasterizer([house.scene], 40).render(np.zeros(4, int), views, FOV)
    for n in range(4):
        true_depth, true_label = ray_cast(house.scene, views[n], 40, FOV)
        # A pixel whose centre lies on an edge may fall to either side of it.
        agree = np.abs(depth[n] - true_depth) < 1e-3 * true_depth
        assert agree.mean() > 0.995
        assert (labels[n] == true_label)[agree].mean() > 0.998


def test_no_holes_from_anywhere_in_many_houses():
    for seed in range(6):
        house = generate_house(seed, rooms=1 + seed)
        views = cameras(house, 40, seed, tilt=1.0)
        _, depth, labels, instances = Rasterizer([house.scene], 48).render(
            np.zeros(40, int), views, FOV)
        assert (depth > 0).all() and (labels > 0).all() and (instances > 0).all()


def test_pictures_do_not_depend_on_batch_or_threads(house):
    other = generate_house(8, rooms=3)
    views = np.concatenate([cameras(house, 6), cameras(other, 6)])
    index = np.repeat([0, 1], 6)
    together = Rasterizer([house.scene, other.scene], 84).render(index, views, FOV)
    parallel = Rasterizer([house.scene, other.scene], 84, threads=2).render(index, views, FOV)
    alone = [Rasterizer([(house, other)[index[n]].scene], 84).render(
        np.zeros(1, int), views[n:n + 1], FOV) for n in range(12)]
    for part in range(4):
        assert np.array_equal(together[part], parallel[part])
        assert np.array_equal(together[part], np.concatenate([one[part] for one in alone]))


def test_a_picture_has_colours_and_texture(house):
    rgb, _, labels, _ = Rasterizer([house.scene], 174).render(
        np.zeros(8, int), cameras(house, 8), FOV)
    assert rgb.std(axis=(1, 2, 3)).min() > 15
    assert len(np.unique(labels)) >= 8


def test_distance_along_the_optical_axis_is_metric():
    builder = SceneBuilder(texture_library())
    builder.polygon([(2, 5, -5), (2, -5, -5), (2, -5, 5), (2, 5, 5)], texture=0, colour=(1, 1, 1),
                    label=3, instance=9)
    render = Rasterizer([builder.build()], 32).render(
        np.zeros(1, int), np.array([[0.0, 0, 0, 0, 0]]), FOV)
    assert np.allclose(render[1], 2.0, atol=1e-5)  # a wall square to the axis: one depth
    assert (render[2] == 3).all() and (render[3] == 9).all()


def test_polygons_are_checked():
    builder = SceneBuilder(texture_library())
    common = {'texture': 0, 'colour': (1, 1, 1), 'label': 1, 'instance': 1}
    with pytest.raises(UserError, match='span a plane'):
        builder.polygon([(0, 0, 0), (1, 0, 0), (2, 0, 0)], **common)
    with pytest.raises(UserError, match='one plane'):
        builder.polygon([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.5)], **common)
    with pytest.raises(UserError, match='finite points'):
        builder.polygon([(0, 0, 0), (1, 0, 0), (1, np.nan, 0)], **common)


def test_nothing_overflows_however_much_there_is_to_see():
    rng = np.random.default_rng(0)
    builder = SceneBuilder(texture_library())
    for _ in range(6000):  # large polygons of many corners, all around and through the camera
        angles = np.sort(rng.uniform(0, 2 * math.pi, 15))
        circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(15)], axis=1)
        axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        points = rng.normal(size=3) + rng.uniform(0.5, 6) * circle @ axes.T
        try:
            builder.polygon(points, texture=int(rng.integers(20)), colour=rng.uniform(0, 1, 3),
                            label=int(rng.integers(1, 50)), instance=int(rng.integers(1, 9999)))
        except UserError:
            continue  # two corners fell together
        if rng.random() < 0.2:
            builder.end_group()
    scene = builder.build()
    views = np.column_stack([rng.normal(size=(40, 3)), rng.uniform(-3, 3, 40),
                             rng.uniform(-1.5, 1.5, 40)])
    for size in (1, 7, 84, 130):
        rgb, depth, labels, _ = Rasterizer([scene], size).render(np.zeros(40, int), views, FOV)
        assert np.isfinite(depth).all() and (depth >= 0).all()
        assert ((labels > 0) == (depth > 0)).all() and labels.max() < 50
    with pytest.raises(UserError, match='pixels a side'):
        Rasterizer([scene], 4096)


def test_culling_never_takes_away_what_can_be_seen(house):
    # The same polygons in one group, and therefore drawn without any test for hiding.
    scene = house.scene
    whole = dataclasses.replace(
        scene, group_start=scene.group_start[[0, -1]], group_room=scene.group_room[:1],
        group_box=np.concatenate([scene.group_box[:, :3].min(0), scene.group_box[:, 3:].max(0)]
                                 )[None])
    views = cameras(house, 60, seed=3, tilt=0.8)
    index = np.zeros(60, int)
    for size in (84, 50):
        one = Rasterizer([scene], size).render(index, views, FOV)
        other = Rasterizer([whole], size).render(index, views, FOV)
        for part in (1, 2, 3):
            assert np.array_equal(one[part], other[part])


def test_a_moved_object_is_drawn_where_it_stands(house):
    ball = object_scene('ball')
    renderer = Rasterizer([house.scene, ball], 84)
    cell = house.floor.centres()[len(house.floor.centres()) // 2]
    views = np.array([[*cell, 1.0, yaw, 0.5] for yaw in np.linspace(-3, 3, 12)])
    away = np.stack([np.cos(views[:, 3]), np.sin(views[:, 3])], axis=1)
    objects = Objects(np.full((12, 1), 1), np.zeros((12, 1, 4)), np.zeros((12, 1), np.int64))
    objects.pose[:, 0, :2] = cell + 0.9 * away
    _, depth, labels, instances = renderer.render(np.zeros(12, int), views, FOV, objects=objects)
    plain = renderer.render(np.zeros(12, int), views, FOV)
    seen = instances == 65535
    assert (seen.sum(axis=(1, 2)) > 60).sum() >= 6  # not where a wall is nearer
    assert (labels[seen] == LABELS.index('ball')).all() and (depth[seen] < plain[1][seen]).all()
    assert np.array_equal(labels[~seen], plain[2][~seen])


def test_distant_textures_are_averaged_not_sampled():
    builder = SceneBuilder(texture_library())
    builder.polygon([(9, 9, -9), (9, -9, -9), (9, -9, 9), (9, 9, 9)],
                    texture=TEXTURES['weave'], colour=(1, 1, 1), label=1, instance=1, tile=0.5)
    rgb = Rasterizer([builder.build()], 64).render(
        np.zeros(1, int), np.array([[0.0, 0, 0, 0, 0]]), FOV)[0]
    texture = texture_library()
    start = texture.start[TEXTURES['weave']]
    assert (texture.texels[start:start + 64 * 64] & 255).std() > 12  # seen from near by
    assert rgb.std() < 4  # threads far below a pixel are one grey


def test_classes_above_255_are_drawn_as_they_are(house):
    seen = Rasterizer([house.scene, object_scene('ball')], 40)
    shift = 40_000
    moved = [dataclasses.replace(scene, face_label=as_labels(scene.face_label.astype(int) + shift),
                                 face_instance=scene.face_instance + np.uint16(50_000))
             for scene in (house.scene, object_scene('ball'))]
    wide = Rasterizer(moved, 40, label_type=np.uint16)
    view = cameras(house, 6, tilt=0.3)
    ahead = view[:, None, :2] + np.stack([np.cos(view[:, 3]), np.sin(view[:, 3])], 1)[:, None]
    things = Objects(np.ones((6, 1), int), np.concatenate([ahead, np.zeros((6, 1, 2))], 2),
                     np.zeros((6, 1), int))
    one = seen.render(np.zeros(6, int), view, FOV, objects=things)
    two = wide.render(np.zeros(6, int), view, FOV, objects=things)
    assert two[2].dtype == np.uint16 and one[2].dtype == np.uint8
    shown = one[1] > 0
    assert np.array_equal(one[0], two[0]) and np.array_equal(one[1], two[1]) and shown.any()
    assert np.array_equal(one[2][shown].astype(int) + shift, two[2][shown])
    own = shown & (one[3] < 65_000)
    assert np.array_equal(one[3][own].astype(int) + 50_000, two[3][own]) and (shown & ~own).any()
    assert np.array_equal(one[3][shown & ~own], two[3][shown & ~own])
    with pytest.raises(UserError, match='class ids of a uint8 are at most 255'):
        Rasterizer(moved, 40)
    with pytest.raises(UserError, match='class ids lie between 0 and 65535'):
        as_labels([0, 65_536])
