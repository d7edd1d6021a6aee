"""OBJ and MTL as programs write them: names, options, colours, polygons; else one error."""

import cv2
import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_sim_bridge.houses.mesh import load_mesh

SQUARE = ('mtllib {library}\no wall_1\nv -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\n'
          'vt 0 0\nvt 0.5 0\nvt 0.5 0.5\nvt 0 0.5\nusemtl my wood\nf 1/1 2/2 3/3 4/4\n')
MATERIAL = 'newmtl my wood\nKd 1 1 1\n{line}\n'


def write(folder, line='map_Kd wood.png', *, library='wall.mtl', at=None, picture='wood.png',
          encoding='utf-8'):
    (folder / 'wall.obj').write_text(SQUARE.format(library=library), encoding=encoding)
    place = folder / (at or library)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(MATERIAL.format(line=line), encoding=encoding)
    if picture:
        rgb = np.zeros((4, 4, 3), np.uint8)
        rgb[:2, :2, 0] = rgb[:2, 2:, 1] = rgb[2:, :2, 2] = 255  # red, green / blue, black
        target = place.parent / picture
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(cv2.imencode('.png', rgb[..., ::-1])[1].tobytes())
    return folder / 'wall.obj'


def coordinates(scene):
    """Texture coordinates {corner (x, z)}: (u, v) with v downwards, whole tiles taken off."""
    return {(round(float(x)), round(float(z))): tuple(np.mod(
        scene.face_uv[k // 3, :, :3] @ (x, y, z) + scene.face_uv[k // 3, :, 3], 1).round(3))
        for k, (x, y, z) in enumerate(scene.vertices.astype(float))}


@pytest.mark.parametrize('library, at', [
    ('wall.mtl', 'wall.mtl'), ('my wall.mtl', 'my wall.mtl'), ('my%20wall.mtl', 'my wall.mtl'),
    ('"my wall.mtl"', 'my wall.mtl'), ('.\\parts\\wall.mtl', 'parts/wall.mtl'),
    ('parts/wall.mtl', 'parts/wall.mtl')])
def test_names_of_libraries(tmp_path, library, at):
    scene = load_mesh(write(tmp_path, library=library, at=at), up='z')
    assert (scene.face_texture == 1).all()  # the picture lies beside the library


def test_several_libraries_in_one_line(tmp_path):
    path = write(tmp_path)
    path.write_text(path.read_text().replace('wall.mtl', 'other.mtl wall.mtl'))
    (tmp_path / 'other.mtl').write_text('newmtl other\nmap_Kd absent.png\n')
    with pytest.raises(UserError, match='absent.png'):
        load_mesh(path)
    (tmp_path / 'other.mtl').write_text('newmtl other\nKd 0 0 0\n')
    assert (load_mesh(path, up='z').face_texture == 1).all()


@pytest.mark.parametrize('line, picture', [
    ('map_Kd my wood.png', 'my wood.png'), ('map_Kd my%20wood.png', 'my wood.png'),
    ('map_kd  wood.png', 'wood.png'), ('\tmap_Kd\twood.png', 'wood.png'),
    ('map_Kd textures\\wood.png', 'textures/wood.png'), ('map_Kd 100%.png', '100%.png'),
    ('map_Kd "my wood.png"', 'my wood.png'),
    ('map_Kd -blendu on -blendv off -mm 0 1 my wood.png', 'my wood.png'),
    ('map_Kd -s 1 1 1 wood.png', 'wood.png'), ('map_Kd -s 1 1 1 -o 0 0 0 7.png', '7.png'),
    ('map_Kd -s 1.000000 1.000000 wood 1.png', 'wood 1.png')])
def test_names_of_textures(tmp_path, line, picture):
    scene = load_mesh(write(tmp_path, line, picture=picture), up='z')
    assert (scene.face_texture == 1).all()
    assert coordinates(scene) == {(-1, -1): (0, 0), (1, -1): (0.5, 0), (1, 1): (0.5, 0.5),
                                  (-1, 1): (0, 0.5)}


def test_latin_1(tmp_path):
    path = write(tmp_path, 'map_Kd h\u00f6lz.png', picture='h\u00f6lz.png', encoding='latin-1')
    assert (load_mesh(path, up='z').face_texture == 1).all()


def test_options_move_the_texture(tmp_path):
    path = write(tmp_path, 'map_Kd -s 0.5 0.2 1 -o 0.1 0.3 wood.png')
    # u = 0.5 u + 0.1; upwards v = 0.2 v + 0.3, so downwards 0.7 - 0.2 v.
    assert coordinates(load_mesh(path, up='z')) == {
        (-1, -1): (0.1, 0.7), (1, -1): (0.35, 0.7), (1, 1): (0.35, 0.6), (-1, 1): (0.1, 0.6)}
    with pytest.raises(UserError, match='-mm 0.5 2'):
        load_mesh(write(tmp_path, 'map_Kd -mm 0.5 2 wood.png'))


def test_kd_multiplies_the_texture(tmp_path):
    scene = load_mesh(write(tmp_path, 'Kd 0.5 0.25 1\nmap_Kd wood.png'), up='z')
    assert scene.face_colour.tolist() == [[0.5, 0.25, 1.0]] * 4  # both sides of two triangles
    scene = load_mesh(write(tmp_path, 'Kd 0.5 0.25 1'), up='z')
    assert scene.face_colour.tolist() == [[0.5, 0.25, 1.0]] * 4 and not scene.face_texture.any()


def test_colours_of_vertices_multiply_kd(tmp_path):
    path = write(tmp_path, 'Kd 0.5 1 1', picture=None)
    text = path.read_text()
    for colours in ('0.5 1 0', '127.5 255 0'):
        lines = [f'{line} {colours}' if line.startswith('v ') else line
                 for line in text.splitlines()]
        path.write_text('\n'.join(lines))
        scene = load_mesh(path, up='z')
        assert scene.face_colour == pytest.approx(np.tile((0.25, 1, 0), (4, 1)))


@pytest.mark.parametrize('line, picture, words', [
    ('map_Kd wood.png', None, 'wood.png'), ('map_Kd C:\\tex\\wood.png', 'wood.png', 'C:'),
    ('map_Kd -s 1 1 1', 'wood.png', 'wall.obj'), ('Kd spectral a.rfl', None, 'Kd'),
    ('map_Kd', None, 'wall.mtl, line 3')])
def test_a_missing_texture_is_an_error_and_not_white(tmp_path, line, picture, words):
    with pytest.raises(UserError, match=words):
        load_mesh(write(tmp_path, line, picture=picture), up='z')


def test_an_undefined_material_is_an_error_and_not_white(tmp_path):
    path = write(tmp_path)
    text = path.read_text()
    path.write_text(text.replace('usemtl my wood', 'usemtl my stone'))
    with pytest.raises(UserError, match='my stone'):
        load_mesh(path)
    path.write_text(text.replace('usemtl my wood', 'usemtl None'))  # as Blender writes none
    assert load_mesh(path, up='z').triangle_count == 4
    path.write_text(text.replace('mtllib wall.mtl', ''))  # then names are for labels alone
    assert not load_mesh(path, up='z').face_texture.any()
    path.write_text(text.replace('wall.mtl', 'absent.mtl'))
    with pytest.raises(UserError, match='absent.mtl'):
        load_mesh(path)


def area(scene):
    corners = scene.vertices.reshape(-1, 3, 3).astype(float)
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
                          axis=1).sum() / 2


@pytest.mark.parametrize('start', range(6))
@pytest.mark.parametrize('turned', [False, True])
def test_polygons_that_are_not_convex_keep_their_shape(tmp_path, start, turned):
    """An L of three squares: a fan from some corners covers too much."""
    corners = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    corners = corners[start:] + corners[:start]
    corners = corners[::-1] if turned else corners
    path = tmp_path / 'l.obj'
    path.write_text('o floor_1\n' + ''.join(f'v {x} {y} 0\n' for x, y in corners)
                    + 'f 1 2 3 4 5 6\n')
    scene = load_mesh(path, up='z', double_sided=False)
    assert scene.triangle_count == 4 and area(scene) == pytest.approx(3.0)
    assert (np.sign(scene.face_plane[:, 2]) == (-1 if turned else 1)).all()
    points = scene.vertices.reshape(-1, 3, 3)[:, :, :2].mean(axis=1)
    assert not ((points > 1).all(axis=1)).any()  # nothing in the missing square


def test_indices_from_the_end_and_lines_that_go_on(tmp_path):
    path = tmp_path / 'a.obj'
    path.write_text('o wall_1\nv 9 9 9\nv 0 0 0\nv 1 0 0\nv 0 0 1\nf -3 \\\n  -2 -1\nl 1 2\np 1\n')
    assert load_mesh(path, up='z').vertices.max() == 1
    for face in ('f 1 2 -5', 'f 1 2 9', 'f 0 1 2', 'f 1 2', 'f 1/3 2/1 3/1', 'f 1 2 x'):
        path.write_text(f'o wall_1\nv 0 0 0\nv 1 0 0\nv 0 0 1\nvt 0 0\n{face}\n')
        with pytest.raises(UserError, match='a.obj'):
            load_mesh(path)
    path.write_text('o wall_1\ncstype bezier\nsurf 0 1 0 1\n')
    with pytest.raises(UserError, match='polygons'):
        load_mesh(path)


@pytest.mark.parametrize('line', [
    'Kd', 'Kd 1 1', 'Kd red', 'Kd 1 nan 1', 'Kd 1 1 x', 'Kd spectral a.rfl', 'map_Kd', 'map_kd\t',
    'newmtl', 'map_Kd -s', 'map_Kd -s wood.png', 'map_Kd -s 1 1 1 absent.png', 'map_Kd -clamp on',
    'map_Kd -clamp wood.png', 'map_Kd -clamp maybe wood.png', 'map_Kd -blendu 3 wood.png',
    'map_Kd -s nan 1 wood.png', 'map_Kd -o inf wood.png', 'map_Kd -foo 1 wood.png',
    'map_Kd -mm 1 wood.png', 'map_Kd -t 1 wood.png', 'map_Kd absent.png'])
def test_a_broken_line_of_a_library_is_one_error_that_names_it(tmp_path, line):
    with pytest.raises(UserError) as caught:
        load_mesh(write(tmp_path, line), up='z')
    text = str(caught.value)
    assert 'wall.mtl, line 3: ' in text and 'Error' not in text and '\n' not in text


@pytest.mark.parametrize('line', ['Kd 1 1 1', 'map_Kd wood.png'])
def test_a_line_that_belongs_to_no_material_is_one_error(tmp_path, line):
    path = write(tmp_path)
    (tmp_path / 'wall.mtl').write_text(f'# a comment \\\nthat goes on\n{line}\n{MATERIAL}')
    with pytest.raises(UserError, match='wall.mtl, line 3: .*no newmtl'):
        load_mesh(path)


@pytest.mark.parametrize('line', [
    'v', 'v 1 2', 'v a b c', 'vt', 'vt x', 'f', 'f 1 2', 'f 1 2 x', 'f 1 2 3.5', 'f 0 1 2',
    'f 1 2 9', 'f 1 2 -9', 'f 1/9 2/1 3/1', 'f 1/0 2/1 3/1', 'f / / /', f'f 1 2 {10**30}',
    'mtllib', 'mtllib absent.mtl', 'surf 0 1', 'f 1/1 2/-5 3/1'])
def test_a_broken_line_of_a_mesh_is_one_error_that_names_it(tmp_path, line):
    path = tmp_path / 'a.obj'
    path.write_text(f'o wall_1\nv 0 0 0\nv 1 0 0\nv 0 0 1\nvt 0 0\nf 1 \\\n2 3\n{line}\nf 1 2 3\n')
    with pytest.raises(UserError) as caught:
        load_mesh(path, up='z')
    text = str(caught.value)
    assert 'a.obj, line 8: ' in text and 'Error' not in text and '\n' not in text


def test_keywords_without_a_meaning_for_surfaces_may_be_bare(tmp_path):
    path = tmp_path / 'a.obj'
    path.write_text('mg\ns\ng\no wall_1\nv 0 0 0\nv 1 0 0\nv 0 0 1\nvn\nusemtl\nf 1 2 3\n')
    assert load_mesh(path, up='z').triangle_count == 2
    path.write_text('o wall_1\nv 0 0 0 nan 1 1\nv 1 0 0 1 1 1\nv 0 0 1 1 1 1\nf 1 2 3\n')
    with pytest.raises(UserError, match='colours of vertices are finite'):
        load_mesh(path, up='z')
