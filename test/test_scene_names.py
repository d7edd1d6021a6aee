"""A scene has one name, with the defaults of its options or without, whoever writes it."""

import gzip
import json

import numpy as np
import pytest
from mesh_places import room_surfaces
from procthor_houses import small_house

from vn_nav.robot import RobotSpec
from vn_nav.scenes import DEFAULTS, SceneName, defaults_of, scene_name
from vn_sim_bridge.houses.mesh_export import export_mesh
from vn_sim_bridge.render.mesh_scene import mesh_scene
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import TABLE, dmlab, gltf, house, procthor, suncg, thor
from vn_sim_bridge.suncg.place import Options

SETUP = Setup(1, RobotSpec(), 24)
NAMED = {'dmlab:arena': 'arena', 'dmlab:maze': 'maze', 'dmlab:*/*': 'custom/house'}


@pytest.mark.parametrize('name', DEFAULTS)
def test_a_scene_with_its_defaults_is_the_scene_without(name):
    simulator = name.partition(':')[0]
    assert simulator in TABLE
    place = NAMED.get(name, '7')
    bare = f'{simulator}:{place}'
    given = defaults_of(simulator, place)
    assert given and scene_name(bare) == bare
    whole = bare + '?' + '&'.join(f'{key}={value}' for key, value in given.items())
    assert scene_name(whole) == bare
    for key, value in given.items():
        assert scene_name(f'{bare}?{key}={value}') == bare
        assert scene_name(f'{bare}?{key}=1{value}') == f'{bare}?{key}=1{value}'


@pytest.mark.parametrize('one, other', [
    ('suncg:h?level=0', 'suncg:h'), ('suncg:h?level=01', 'suncg:h?level=1'),
    ('house:007?rooms=05', 'house:7'), ('dmlab:maze?seed=03&size=7', 'dmlab:maze?seed=3'),
    ('procthor:a.jsonl?index=03', 'procthor:a.jsonl?index=3'),
    ('gltf:a.glb?scale=1.0&height=1.20', 'gltf:a.glb'),
    ('thor:FloorPlan1?objects=random&moves=bisect', 'thor:FloorPlan1?objects=random')])
def test_two_names_of_one_scene_are_never_different(one, other):
    assert scene_name(one) == scene_name(other) == other


@pytest.mark.parametrize('name', [
    'gltf:hm3d.json?scene=00800', 'suncg:007', 'grid:a?goals=03', 'examples.corridor:8?size=07',
    'dmlab:arena?seed=0', 'house:7?rooms=50'])
def test_what_is_no_default_and_no_number_stays(name):
    assert scene_name(name) == name


def both(simulator, place):
    """A scene's name without options, and with the defaults written out, past `parse_scene`."""
    options = tuple(sorted(defaults_of(simulator, place).items()))
    assert options
    return SceneName(simulator, place), SceneName(simulator, place, options)


@pytest.mark.slow
def test_the_simulators_have_those_defaults(tmp_path):
    """What the table says is what each does where nothing is said."""
    for place in ('arena', 'maze', 'custom/house'):
        bare, whole = (dmlab.level_of(scene, SETUP)[0] for scene in both('dmlab', place))
        assert bare == whole
    bare, whole = both('thor', 'FloorPlan1')
    assert thor._options(bare) == thor._options(whole)
    bare, whole = both('suncg', 'h')
    assert suncg._options(bare) == suncg._options(whole) == Options()
    for name in ('labels', 'depth'):
        wanted = dict(whole.options)[name]
        assert suncg._common([whole], name, suncg.COMMON[name]) == suncg.COMMON[name] == wanted
    houses = house.open_houses(both('house', '3'))
    assert len({len(one.rooms) for one in houses}) == 1
    with gzip.open(tmp_path / 'house.json.gz', 'wt') as file:
        json.dump(small_house(), file)
    export_mesh(mesh_scene(room_surfaces(), 'room'), tmp_path / 'room.glb')
    for module, file in ((procthor, 'house.json.gz'), (gltf, 'room.glb')):
        name = module.__name__.rpartition('.')[2]
        bare, whole = (module.SIMULATOR.open([scene], SETUP).places[0].obstacle_rects
                       for scene in both(name, f'{tmp_path}/{file}'))
        assert np.array_equal(bare, whole)
