"""What a mesh file means and is not drawn so is said, in one line, once; and trimesh agrees."""

import numpy as np
import pytest
import trimesh
from gltf_files import SQUARE, Gltf

from vn_sim_bridge import notices
from vn_sim_bridge.houses.mesh import load_mesh, read_parts
from vn_sim_bridge.meshes import vocabulary as vocabulary_module
from vn_sim_bridge.meshes.vocabulary import Vocabulary
from vn_sim_bridge.render.mesh_scene import Surface, mesh_scene


def plain(**material):
    file = Gltf()
    file.node(file.square(material=file.material(factor=(1, 1, 1), **material)))
    return file


def shaded():
    file = Gltf()
    colours = file.accessor([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0)])
    file.node(file.square(COLOR_0=colours))
    return file


def with_more(**entries):
    file = plain()
    file.json.update(entries)
    return file


@pytest.mark.parametrize(('make', 'words'), [
    (lambda: plain(alphaMode='BLEND'), 'transparency'),
    (lambda: plain(alphaMode='MASK'), 'transparency'),
    (lambda: plain(emissiveFactor=[1.0, 0.5, 0.0]), 'emissive'),
    (shaded, 'averaged over each triangle'),
    (lambda: with_more(extensionsUsed=['ACME_glow']), 'ACME_glow'),
    (lambda: with_more(animations=[{'channels': [], 'samplers': []}]), 'animations'),
])
def test_what_is_left_out_of_gltf_is_said_once(tmp_path, capsys, make, words):
    path = make().write(tmp_path / 'square.glb')
    for _ in range(2):
        load_mesh(path)
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and words in said[0] and 'square.glb' in said[0]


@pytest.mark.parametrize(('line', 'said'), [('d 0.5', 1), ('map_d leaf.png', 1), ('Tr 0.3', 1),
                                            ('d 1.0', 0), ('Tr 0', 0), ('Ns 10', 0)])
def test_what_is_left_out_of_obj_is_said_once(tmp_path, capsys, line, said):
    (tmp_path / 'a b.mtl').write_text(f'newmtl m\nKd 1 1 1\n{line}\n')
    (tmp_path / 'a b.obj').write_text('mtllib a b.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\n'
                                      'f 1 2 3\n')
    load_mesh(tmp_path / 'a b.obj', default_label='wall')
    assert len(capsys.readouterr().err.splitlines()) == said


def test_of_many_places_the_first_notes_are_written(tmp_path, capsys):
    for number in range(12):
        load_mesh(plain(alphaMode='BLEND').write(tmp_path / f'{number}.glb'))
    load_mesh(plain(emissiveFactor=[1.0, 0.5, 0.0]).write(tmp_path / 'lamp.glb'))
    *said, other = capsys.readouterr().err.splitlines()
    assert len(said) == notices.MOST and 'emissive' in other
    assert ['left out)' in line for line in said] == [False] * (notices.MOST - 1) + [True]


def test_a_file_that_loses_nothing_says_nothing(tmp_path, capsys):
    load_mesh(plain().write(tmp_path / 'square.glb'))
    assert capsys.readouterr().err == ''


def test_textures_beyond_the_budget_are_halved_and_it_is_said(capsys):
    uv = np.array([[(0, 0), (1, 0), (1, 1)]], float)
    corners = np.array([[(0, 0, 0), (1, 0, 0), (1, 1, 0)]], float)
    pictures = [np.full((256, 256, 3), k, np.uint8) for k in (10, 20, 30)]
    surfaces = [Surface(corners + k, uv, np.ones(3), picture, 1, 1)
                for k, picture in enumerate(pictures)]
    scene = mesh_scene(surfaces, 'a flat', most_texels=3 * 128 * 128 + 16)
    assert scene.textures.side == [4, 128, 128, 128]
    assert 'a flat: textures are drawn with at most 128 pixels' in capsys.readouterr().err


def test_more_classes_than_a_pixel_can_name_is_said(capsys, monkeypatch):
    monkeypatch.setattr(vocabulary_module, 'MOST_LABELS', 256)
    vocabulary = Vocabulary({f'class {k}': 300 - k for k in range(300)}, 'the scenes')
    assert len(vocabulary.names) == 256
    assert 'has 300 classes' in capsys.readouterr().err
    assert vocabulary.names[vocabulary.id('class 3')] == 'class_3'
    assert vocabulary.names[vocabulary.id('class 299')] == 'object', 'the rarest'
    assert vocabulary.names[vocabulary.id('Tv Monitor')] == 'tv'


def triangles(parts):
    """Sorted corners of parts, to compare what two readers make of a file."""
    corners = np.concatenate([part.corners for part in parts]).reshape(-1, 9)
    return corners[np.lexsort(corners.round(5).T)]


def foreign(path):
    """The triangles as trimesh reads them."""
    scene = trimesh.load_scene(path, process=False)
    corners = np.concatenate([mesh.triangles for mesh in scene.dump()]).reshape(-1, 9)
    return corners[np.lexsort(corners.round(5).T)]


def test_trimesh_reads_the_same_gltf(tmp_path):
    file = Gltf()
    mesh = file.square(points=[(x * 1.5, y, 0.25) for x, y, _ in SQUARE])
    inner = file.node(mesh, translation=[1, 2, 3], rotation=[0, 0.6, 0, 0.8])
    outer = file.node(mesh, scale=[2, 1, 0.5], children=[inner])
    file.json['scenes'] = [{'nodes': [outer]}]
    for ending in ('glb', 'gltf'):
        path = file.write(tmp_path / f'two squares.{ending}')
        file.json['buffers'] = [{}]
        assert np.allclose(triangles(read_parts(path)), foreign(path), atol=1e-5)


def test_trimesh_reads_the_same_obj(tmp_path):
    path = tmp_path / 'a room.obj'
    path.write_text('v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\nv 1 1 3\no top\nf 1 2 3\nf 1 3 4\n'
                    'g side\nf -5 -4 -1\n')
    assert np.allclose(triangles(read_parts(path)), foreign(path), atol=1e-6)
