"""`gltf:` an embedded house as GLB is the same house again; Habitat's data sets; many scenes."""

import functools
import json

import numpy as np
import pytest
from conformance import ROBOT, SIZE, Conformance, resident_mb
from gltf_files import Gltf
from mesh_places import FLOOR, TABLE, WALL, box, flat, room_surfaces

from vn_nav.errors import UserError
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.mesh_export import export_mesh
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.render.mesh_scene import mesh_scene
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator


@functools.cache
def exported(folder, seed=7, rooms=2):
    """An embedded house as a GLB file."""
    path = folder / f'house_{seed}_{rooms}.glb'
    export_mesh(generate_house(seed, rooms=rooms).scene, path)
    return path


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('scenes')


def opened(*scenes, num_envs=1, size=SIZE, **more):
    return open_simulator(list(scenes), Setup(num_envs, ROBOT, size, **more))


def write_room(path, width=6.0, **more):
    """A room of `mesh_places` as a GLB file."""
    export_mesh(mesh_scene(room_surfaces(width=width, **more), 'room'), path)
    return path


@pytest.mark.slow
class TestGltf(Conformance):
    @pytest.fixture(autouse=True)
    def files(self, folder):
        self.folder = folder

    def make(self, num_envs, size=SIZE):
        return opened(f'gltf:{exported(self.folder)}', f'gltf:{exported(self.folder, 3, 1)}',
                      num_envs=num_envs, size=size)


@pytest.mark.parametrize(('seed', 'rooms'), [(7, 2), (12003, 4)])
def test_an_embedded_house_is_the_same_house_again(folder, seed, rooms):
    house = generate_house(seed, rooms=rooms)
    mine = opened(f'gltf:{exported(folder, seed, rooms)}', size=64)
    theirs = opened(f'house:{seed}?rooms={rooms}', size=64)
    cells = house.floor.centres()
    rng = np.random.default_rng(0)
    poses = np.column_stack([cells[rng.integers(len(cells), size=24)],
                             rng.uniform(-3, 3, 24), rng.uniform(-.3, .5, 24)])
    a, b = (simulator.view(np.zeros(24, int), poses) for simulator in (mine, theirs))
    same = np.abs(a.depth - b.depth) < 0.01
    assert same.mean() > 0.999, 'depth within 1 cm'
    names = np.array(mine.label_names)
    assert (names[a.labels] == np.array(LABELS)[b.labels]).mean() > 0.999
    free = mine.places[0].floor
    at = np.floor((cells - free.origin) / 0.1 + 1e-6).astype(int)
    assert free.free[at[:, 1], at[:, 0]].mean() > 0.97, 'where a robot could stand it can again'


def test_what_its_walls_are_made_of_stops_a_robot(folder):
    simulator = opened(f'gltf:{exported(folder)}', num_envs=2, size=48)
    cells, _ = simulator.places[0].starts()
    simulator.place(np.arange(2), np.array([[*cells[5], 0.3, 0], [*cells[-9], 2.0, 0]]))
    for _ in range(40):
        motion = simulator.move(np.array([[0.5, 0, 0, 0]] * 2))
    assert motion.collided.all()
    for goal in simulator.places[0].goals:
        seen = simulator.view(np.array([0]), np.array([goal.pose]))
        assert len(np.unique(seen.labels)) > 3 and np.median(seen.depth) > 0.8


def test_axes_scale_storeys_and_doors_are_options(tmp_path):
    write_room(tmp_path / 'room.glb')
    simulator = opened(f'gltf:{tmp_path}/room.glb?scale=2')
    depth = simulator.view(np.array([0]), np.array([[2.0, 6.0, 0, 0]])).depth
    assert depth[0, SIZE // 2, SIZE // 2] == pytest.approx(10, abs=.02)
    with pytest.raises(UserError, match='0 to 0'):
        opened(f'gltf:{tmp_path}/room.glb?storey=1')
    for wrong, rule in (('up=x', "'y' or 'z'"), ('scale=-1', 'positive'), ('doors=shut', 'doors'),
                        ('scene=a', 'single file'), ('color=red', 'options of a scene'),
                        ('labels=none.json', 'none.json')):
        with pytest.raises(UserError, match=rule):
            opened(f'gltf:{tmp_path}/room.glb?{wrong}')


@pytest.mark.parametrize(('name', 'rule'), [
    ('none.glb', 'docs/simulators/gltf.md'), ('notes.txt', 'ends in'), ('broken.glb', 'mesh file'),
    ('x.scene_dataset_config.json', 'is JSON'),
])
def test_bad_files_are_one_line_at_the_start(tmp_path, name, rule):
    (tmp_path / 'notes.txt').write_text('no mesh')
    (tmp_path / 'broken.glb').write_bytes(b'glTF and no more')
    (tmp_path / 'x.scene_dataset_config.json').write_text('{"stages": ')
    with pytest.raises(UserError, match=rule) as caught:
        opened(f'gltf:{tmp_path}/{name}')
    assert '\n' not in str(caught.value)


def test_names_without_a_class_are_labelled_by_direction(tmp_path, capsys):
    scene = mesh_scene(room_surfaces(), 'room')
    export_mesh(scene, tmp_path / 'room.glb')
    data = (tmp_path / 'room.glb').read_bytes()
    for name in (b'wall', b'ceiling', b'floor', b'table'):
        data = data.replace(name, b'q' * len(name))
    (tmp_path / 'room.glb').write_bytes(data)
    simulator = opened(f'gltf:{tmp_path}/room.glb')
    frames = simulator.view(np.array([0]), np.array([[1.0, 2.0, 0, 0.2]]))
    assert set(np.unique(frames.labels)) <= {WALL, FLOOR, LABELS.index('ceiling')}
    assert 'by direction' in capsys.readouterr().err


# Habitat's data sets

def solid(corners, name, colour=(1, 1, 1), path=None, z_up=False):
    """Triangles [T,3,3] (z up) as a GLB file with one node."""
    points = corners.reshape(-1, 3)
    out = points if z_up else points[:, [0, 2, 1]] * (1, 1, -1)
    file = Gltf()
    mesh = file.square(material=file.material(factor=colour), points=out.tolist(),
                       faces=list(range(len(points))))
    file.node(mesh)
    file.json['nodes'][-1]['name'] = name
    return file.write(path)


def write_dataset(root, scenes=('home_1', 'home_2')):
    """A data set as Habitat's: a stage, an object with a class, a table of classes, regions."""
    for name in ('stages', 'objects', 'scenes', 'semantics/scenes', 'metadata'):
        (root / name).mkdir(parents=True)
    walls = np.concatenate([s.corners for s in room_surfaces()[:-1]])
    # A stage with z up, in centimetres.
    solid(walls * 100, 'mesh', path=root / 'stages' / 'shell.glb', z_up=True)
    (root / 'stages/shell.stage_config.json').write_text(json.dumps({
        'render_asset': 'shell.glb', 'up': [0, 0, 1], 'front': [0, 1, 0],
        'units_to_meters': 0.01}))
    solid(box(0, 0, 0, 1, 1, .8), 'mesh', (.2, .4, .9), root / 'objects' / 'a 17.glb')
    (root / 'objects/a17.object_config.json').write_text(json.dumps({'render_asset': 'a 17.glb'}))
    (root / 'metadata/objects.csv').write_text('id,main_category\na17,chest_of_things\n')
    for number, name in enumerate(scenes):
        (root / f'scenes/{name}.scene_instance.json').write_text(json.dumps({
            'stage_instance': {'template_name': 'stages/shell'},
            'object_instances': [{
                'template_name': 'objects/a17', 'translation': [4.0, 0.4, -2.0 - number],
                'rotation': [0.7071068, 0, 0.7071068, 0], 'uniform_scale': 1.0}],
            'semantic_scene_instance': name}))
        (root / f'semantics/scenes/{name}.semantic_config.json').write_text(json.dumps({
            'region_annotations': [
                {'name': 'kitchen/0', 'label': 'kitchen', 'floor_height': 0.0,
                 'extrusion_height': 2.5, 'poly_loop': [[0, 0, 0], [3, 0, 0], [3, 0, -4],
                                                        [0, 0, -4]]},
                {'name': 'attic', 'label': 'attic', 'floor_height': 6.0, 'extrusion_height': 2.5,
                 'poly_loop': [[0, 6, 0], [3, 6, 0], [3, 6, -4]]}]}))
    path = root / 'homes.scene_dataset_config.json'
    path.write_text(json.dumps({
        'stages': {'paths': {'.json': ['stages/*.stage_config.json']}},
        'objects': {'paths': {'.json': ['objects']}},
        'scene_instances': {'paths': {'.json': ['scenes']}},
        'semantic_scene_descriptor_instances': {'paths': {'.json': ['semantics/scenes']}}}))
    return path


def test_a_habitat_scene_is_put_together(tmp_path):
    path = write_dataset(tmp_path)
    simulator = opened(f'gltf:{path}?scene=home_2')
    (place,) = simulator.places
    assert place.name == f'gltf:{path}?scene=home_2'
    assert 'chest_of_things' in simulator.label_names
    thing = simulator.label_names.index('chest_of_things')
    # Its middle stands at x = 4, y = 3 (the second scene's), and it is 1 m wide.
    frames = simulator.view(np.array([0]), np.array([[1.0, 3.0, 0, 0.3]]))
    assert frames.labels[0, SIZE // 2, SIZE // 2] == thing
    rect = [rect for rect, label in place.obstacles if label == 'chest_of_things'][0]
    assert np.allclose(rect, (3.5, 2.5, 4.5, 3.5), atol=0.03)
    assert {room.kind for room in place.rooms} == {'kitchen'}, 'the attic is another storey'
    assert [goal.room for goal in place.goals] == ['kitchen/0']
    assert {WALL, FLOOR} <= set(np.unique(frames.labels)), 'the stage is labelled by direction'


def test_a_pattern_means_several_scenes(tmp_path):
    path = write_dataset(tmp_path)
    simulator = opened(f'gltf:{path}?scene=home_*', num_envs=2)
    assert [place.name[-6:] for place in simulator.places] == ['home_1', 'home_2']
    with pytest.raises(UserError, match='one of 2: home_1, home_2'):
        opened(f'gltf:{path}')
    with pytest.raises(UserError, match='one of 2.*home_9'):
        opened(f'gltf:{path}?scene=home_9')
    with pytest.raises(UserError, match='axes and scale'):
        opened(f'gltf:{path}?scene=home_1&up=z')


def annotate(path, *categories):
    """Semantic files beside a stage, all of whose (white) surfaces are of the first category."""
    path.with_suffix('.semantic.glb').write_bytes(path.read_bytes())
    path.with_suffix('.semantic.txt').write_text('HM3D Semantic Annotations\n' + ''.join(
        f'{k},{0xFFFFFF - k:06X},"{name}",0\n' for k, name in enumerate(categories)))
    return path


def test_a_class_has_one_number_whoever_else_is_open(tmp_path):
    """Of a data set with a table, semantic ids and a semantic file, each in another scene."""
    path = write_dataset(tmp_path)
    room = tmp_path / 'stages/annotated.glb'
    write_room(room)
    annotate(room, 'zither', 'abacus')
    (tmp_path / 'stages/annotated.stage_config.json').write_text(json.dumps(
        {'render_asset': 'annotated.glb'}))
    (tmp_path / 'scenes/home_0.scene_instance.json').write_text(json.dumps(
        {'stage_instance': {'template_name': 'stages/annotated'}}))
    described = tmp_path / 'semantics/scenes/home_1.semantic_config.json'
    described.write_text(json.dumps({**json.loads(described.read_text()),
                                     'classes': [{'id': 7, 'name': 'banjo'}]}))
    alone = [opened(f'gltf:{path}?scene=home_{k}').label_names for k in range(3)]
    together = opened(f'gltf:{path}?scene=home_*', num_envs=3).label_names
    assert alone == [together] * 3
    assert together == (*LABELS, 'abacus', 'banjo', 'chest_of_things', 'zither')


def test_files_with_classes_of_their_own_need_one_list_to_be_opened_together(tmp_path):
    first, second, plain = (write_room(tmp_path / f'{name}.glb') for name in 'abc')
    annotate(first, 'zither')
    annotate(second, 'abacus')
    assert opened(f'gltf:{plain}', f'gltf:{first}').label_names == (*LABELS, 'zither')
    with pytest.raises(UserError, match='alike.*a.glb.*labels=FILE'):
        opened(f'gltf:{first}', f'gltf:{plain}', f'gltf:{second}')
    (tmp_path / 'labels.json').write_text('{"labels": ["abacus", "zither"]}')
    options = f'?labels={tmp_path}/labels.json'
    assert opened(f'gltf:{first}{options}', f'gltf:{second}{options}', num_envs=2).label_names == (
        *LABELS, 'abacus', 'zither')


@pytest.mark.parametrize(('change', 'rule'), [
    (lambda root: (root / 'stages/shell.glb').unlink(), 'shell.glb'),
    (lambda root: (root / 'objects/a17.object_config.json').unlink(), 'a17'),
    (lambda root: (root / 'scenes/home_1.scene_instance.json').write_text('[]'), 'JSON object'),
    (lambda root: (root / 'stages/shell.stage_config.json').write_text(json.dumps(
        {'render_asset': 'shell.glb', 'up': [0, 0, 1], 'front': [0, 0, 1]})), 'right angles'),
])
def test_a_data_set_that_is_not_whole_is_refused(tmp_path, change, rule):
    path = write_dataset(tmp_path)
    change(tmp_path)
    with pytest.raises(UserError, match=rule):
        opened(f'gltf:{path}?scene=home_1')


def test_semantic_files_give_classes_instances_and_regions(tmp_path):
    room = room_surfaces()
    export_mesh(mesh_scene(room, 'room'), tmp_path / 'flat.basis.glb')
    colours = {}
    file = Gltf()
    for k, part in enumerate(room):
        code = (40 + 20 * k, 7 * k, 200 - k)
        colours[k] = code
        points = part.corners.reshape(-1, 3)[:, [0, 2, 1]] * (1, 1, -1)
        shade = file.accessor([tuple(c / 255 for c in code)] * len(points))
        file.node(file.square(points=points.tolist(), faces=list(range(len(points))),
                              COLOR_0=shade))
    file.write(tmp_path / 'flat.semantic.glb')
    names = ['floor', 'ceiling', *['wall'] * 4, 'billiard table']
    lines = [f'{k + 1},{r:02X}{g:02X}{b:02X},"{names[k]}",{0 if k < 2 else 1}'
             for k, (r, g, b) in colours.items()]
    (tmp_path / 'flat.semantic.txt').write_text('HM3D Semantic Annotations\n' + '\n'.join(lines))
    simulator = opened(f'gltf:{tmp_path}/flat.basis.glb', size=64)
    assert 'billiard_table' in simulator.label_names
    frames = simulator.view(np.array([0]), np.array([[0.8, 1.5, 0, 0.2]]))
    shown = {simulator.label_names[k] for k in np.unique(frames.labels)}
    assert shown == {'floor', 'ceiling', 'wall', 'billiard_table'}
    table = frames.labels[0] == simulator.label_names.index('billiard_table')
    assert set(np.unique(frames.instances[0][table])) == {8}, 'its number, and 1'
    plain = opened(f'gltf:{write_room(tmp_path / "other.glb")}', size=64).view(
        np.array([0]), np.array([[0.8, 1.5, 0, 0.2]]))
    assert ((plain.labels[0] == TABLE) == table).mean() > 0.99
    assert {room.name for room in simulator.places[0].rooms} == {'region 0'}
    (tmp_path / 'flat.semantic.txt').write_text('other\n')
    with pytest.raises(UserError, match='begins with'):
        opened(f'gltf:{tmp_path}/flat.basis.glb')


@pytest.mark.slow
def test_many_scenes_are_not_in_memory_at_once(tmp_path):
    """A split of 120 scenes with a texture of 2 MB each, within the memory of a few."""
    rng = np.random.default_rng(0)
    uv = np.tile(np.array([(0, 0), (1, 0), (1, 1)], float), (2, 1, 1))
    for k in range(120):
        picture = rng.integers(0, 255, (256, 256, 3)).astype(np.uint8)
        floor = room_surfaces(width=6 + k % 7)
        floor[0] = floor[0]._replace(corners=flat(0, 0, 6 + k % 7, 4), uv=uv, picture=picture)
        export_mesh(mesh_scene(floor, 'room'), tmp_path / f'flat_{k:03}.glb')
    scenes = [f'gltf:{tmp_path}/flat_{k:03}.glb' for k in range(120)]
    simulator = opened(*scenes, num_envs=4)
    simulator.cache.budget = 4 << 20
    for place in simulator.places[:20]:
        assert place.goals
    before = resident_mb()
    for place in simulator.places:
        assert place.goals and place.floor.free.any()
    for k in range(0, 120, 4):
        simulator.enter(np.arange(4), np.arange(k, k + 4))
        simulator.place(np.arange(4), np.array([[1.0, 3.0, 0, 0]] * 4))
        depth = simulator.observe().depth[:, SIZE // 2, SIZE // 2]
        assert np.allclose(depth, 5 + np.arange(k, k + 4) % 7, atol=0.02)
    assert resident_mb() - before < 40
    assert len(simulator.cache) < 24
    simulator.close()
