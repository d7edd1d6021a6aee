"""Scenes of glTF, GLB and OBJ files, and of Habitat's data sets.

`gltf:flat.glb`, `gltf:hssd.scene_dataset_config.json?scene=102344250`; `scene=00*` are several.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vn_nav.errors import UserError
from vn_nav.scenes import SceneName, options_of, whole_number
from vn_nav.structured_file import read_json
from vn_sim_bridge.floor.mesh_floor import HEIGHT
from vn_sim_bridge.meshes.classes import (
    common_names,
    dataset_classes,
    file_classes,
    files_beside,
    files_of,
)
from vn_sim_bridge.meshes.habitat import ASSETS, SUFFIX, Dataset, Instance
from vn_sim_bridge.meshes.parts import MAP, by_direction, named_surfaces
from vn_sim_bridge.meshes.place import MeshPlace, PlaceRules, RoomOutline, make_place
from vn_sim_bridge.meshes.semantics import SemanticMesh, Thing, read_annotations, split_large
from vn_sim_bridge.meshes.simulator import MeshSimulator
from vn_sim_bridge.meshes.vocabulary import OTHER, Vocabulary, class_name
from vn_sim_bridge.notices import say_once
from vn_sim_bridge.render.mesh_scene import MOST_INSTANCES, Surface
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.simulator import Setup

OPTIONS = ('scene', 'storey', 'up', 'scale', 'height', 'labels', 'doors')
FIRST_OBJECT = 10_000  # number of an instance; those of the stage are before it
REGION_MARGIN = 0.3  # m below and above what a region's objects span


class GltfSimulator(MeshSimulator):
    """Robots in scenes of mesh files."""

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> GltfSimulator:
        """See `BaseSimulator.open`."""
        datasets: dict[Path, Dataset] = {}
        found: list[_MeshFile | _HabitatScene] = []
        for scene in scenes:
            options_of(scene, OPTIONS)
            path = Path(scene.place).expanduser()
            if not path.is_file():
                raise UserError('a scene of gltf is a file: .glb, .gltf, .obj or '
                                f'{SUFFIX}', str(scene), 'correct the path; data sets are not '
                                'shipped: docs/simulators/gltf.md says where to get them')
            if path.suffix.lower() in ASSETS:
                found.append(_MeshFile(scene, path))
            elif path.name.endswith(SUFFIX):
                if path not in datasets:
                    datasets[path] = Dataset(path)
                dataset = datasets[path]
                found += [_HabitatScene(one, dataset) for one in _chosen(scene, dataset)]
            else:
                raise UserError(f'a scene of gltf ends in {", ".join(ASSETS)} or {SUFFIX}',
                                str(scene), 'convert it, for instance with Blender')
        vocabularies = _vocabularies(found)
        names = [str(one.scene) for one in found]
        return cls(names, [functools.partial(one.make, setup, vocabulary)
                           for one, vocabulary in zip(found, vocabularies, strict=True)], setup,
                   common_names(vocabularies, names), rooms=all(one.has_rooms for one in found))


def _chosen(scene: SceneName, dataset: Dataset) -> list[SceneName]:
    """The scenes of a data set that a name means: one, or all that a pattern fits."""
    given = dict(scene.options)
    pattern = given.pop('scene', None)
    if pattern is None and len(dataset.names()) == 1:
        pattern = dataset.names()[0]
    names = dataset.names(pattern) if pattern else []
    if not names:
        dataset.scene(pattern or 'none')  # says which there are
    return [scene._replace(options=tuple(sorted({**given, 'scene': name}.items())))
            for name in names]


def _vocabularies(found: Sequence[_MeshFile | _HabitatScene]) -> list[Vocabulary]:
    """The classes of each scene: of its file, its data set, or a list that an option names."""
    lists = {dict(one.scene.options).get('labels') for one in found} - {None}
    if len(lists) > 1:
        raise UserError('scenes that are opened together have one list of labels',
                        ', '.join(sorted(map(str, lists))), 'give the same to all')
    if lists:
        (path,) = map(str, lists)
        remedy = 'write {"labels": ["sofa", "lamp"]}'
        names = read_json(path, 'a list of labels', remedy).get('labels')
        if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise UserError('a list of labels has names under "labels"', path, remedy)
        return [Vocabulary(dict.fromkeys(names, 1), path)] * len(found)
    known: dict[object, Vocabulary] = {}
    for one in found:
        if one.origin not in known:
            known[one.origin] = Vocabulary(dict.fromkeys(one.classes(), 1), str(one.origin))
    return [known[one.origin] for one in found]


class _Scene:
    """What mesh files and Habitat's scenes have in common."""

    has_rooms = False

    def __init__(self, scene: SceneName):
        self.scene = scene
        options = dict(scene.options)
        storey = options.get('storey')
        self.rules = PlaceRules(
            storey=None if storey is None else whole_number(scene, 'storey', storey),
            height=_number(scene, options, 'height', HEIGHT),
            passable=_doors(scene, options))

    def place(self, surfaces: list[Surface], rooms: Sequence[RoomOutline], setup: Setup,
              vocabulary: Vocabulary) -> tuple[MeshPlace, Scene]:
        """The place of some surfaces."""
        return make_place(str(self.scene), surfaces, vocabulary.names, setup.robot, rooms=rooms,
                          rules=self.rules, goals_per_room=setup.goals_per_room,
                          goal_seed=setup.goal_seed)


class _MeshFile(_Scene):
    """A file by itself: classes by the names of its parts, or by semantic files beside it."""

    def __init__(self, scene: SceneName, path: Path):
        super().__init__(scene)
        self.path = path
        options = dict(scene.options)
        if options.get('up', 'y') not in ('y', 'z'):
            raise UserError("the axis that points up is 'y' or 'z'", str(scene), 'choose one')
        if 'scene' in options:
            raise UserError('scene=NAME chooses out of a data set', str(scene),
                            'leave it out for a single file')
        self.matrix = (np.eye(4) if options.get('up') == 'z' else MAP) @ np.diag(
            [_number(scene, options, 'scale', 1.0)] * 3 + [1.0])
        self.origin = path  # of its classes
        self.semantic = files_beside(path)
        self.has_rooms = self.semantic is not None

    def classes(self) -> set[str]:
        """Those of its semantic file."""
        return file_classes(self.semantic)

    def make(self, setup: Setup, vocabulary: Vocabulary) -> tuple[MeshPlace, Scene]:
        """Read it."""
        surfaces = named_surfaces(self.path, self.matrix, vocabulary)
        if self.semantic is None:
            if all(surface.label == vocabulary.id(OTHER) for surface in surfaces):
                say_once(f'{self.path.name}: no node is named by a class and there is no '
                         '.semantic.txt: labels are floor, ceiling and wall by direction')
                surfaces = by_direction(surfaces, vocabulary)
            return self.place(surfaces, (), setup, vocabulary)
        surfaces, rooms = annotated(surfaces, *self.semantic, self.matrix, vocabulary)
        return self.place(surfaces, rooms, setup, vocabulary)


class _HabitatScene(_Scene):
    """A scene of a data set."""

    def __init__(self, scene: SceneName, dataset: Dataset):
        super().__init__(scene)
        self.dataset, self.name = dataset, dict(scene.options)['scene']
        self.origin = dataset.path  # of its classes
        if {'up', 'scale'} & dict(scene.options).keys():
            raise UserError('axes and scale of a data set stand in its configuration', str(scene),
                            'leave out up and scale')
        self.parts = dataset.scene(self.name)  # small: names and matrices
        self.semantic = files_of(self.parts.stage.template)
        self.has_rooms = bool(self.parts.regions) or self.semantic is not None

    def classes(self) -> set[str]:
        """Those of its data set."""
        return dataset_classes(self.dataset)

    def make(self, setup: Setup, vocabulary: Vocabulary) -> tuple[MeshPlace, Scene]:
        """Read stage and objects."""
        surfaces = self._read(self.parts.stage, vocabulary, 0)
        rooms = [_region(entry, self.scene) for entry in self.parts.regions]
        if self.semantic is not None:
            matrix = MAP @ self.parts.stage.template.matrix(semantic=True)
            surfaces, own = annotated(surfaces, *self.semantic, matrix, vocabulary)
            rooms = rooms or own
        else:
            surfaces = by_direction(surfaces, vocabulary)
        for k, instance in enumerate(self.parts.objects):
            category = self.dataset.category(instance.template, self.parts.classes)
            known = (vocabulary.of_names([instance.template.name]) if category is None
                     else vocabulary.id(category))
            surfaces += self._read(instance, vocabulary, FIRST_OBJECT + k, known, whole=True)
        return self.place(surfaces, rooms, setup, vocabulary)

    def _read(self, instance: Instance, vocabulary: Vocabulary, number: int,
              known: int | None = None, *, whole: bool = False) -> list[Surface]:
        path = instance.template.asset()
        if path is None:
            raise UserError('a stage or an object has a render_asset', instance.template.name,
                            'take the data set as it was downloaded')
        found = named_surfaces(path, instance.matrix, vocabulary, number, known=known,
                               instance=number if whole else None)
        if not instance.by_middle:
            return found
        # Its position is that of its middle, which Habitat takes for the centre of mass.
        corners = np.concatenate([surface.corners for surface in found])
        local = (corners - instance.matrix[:3, 3]) @ np.linalg.inv(instance.matrix[:3, :3]).T
        middle = (local.min(axis=(0, 1)) + local.max(axis=(0, 1))) / 2
        shift = instance.matrix[:3, :3] @ middle
        return [surface._replace(corners=surface.corners - shift) for surface in found]


def annotated(surfaces: Sequence[Surface], mesh: Path, text: Path, matrix: np.ndarray,
              vocabulary: Vocabulary) -> tuple[list[Surface], list[RoomOutline]]:
    """Surfaces with the classes and instances of semantic files, and the rooms of their regions.

    Args:
        surfaces: in the map frame.
        mesh, text: the .semantic.glb and .semantic.txt files.
        matrix: [4,4] from the axes of the semantic mesh to the map frame.
        vocabulary: of the simulator.
    """
    things = read_annotations(text)
    semantic = SemanticMesh(mesh, things, matrix)
    found = []
    for surface in surfaces:
        corners, uv, colour = split_large(
            surface.corners, surface.uv,
            np.broadcast_to(surface.colour, (len(surface.corners), 3)))
        shown = [things.get(int(code)) for code in semantic.at(corners.mean(axis=1))]
        labels = np.array([vocabulary.id(thing.category if thing else OTHER) for thing in shown])
        instances = np.array([thing.number % (MOST_INSTANCES - 2) + 1 if thing else 0
                              for thing in shown])
        found.append(surface._replace(corners=corners, uv=uv, colour=colour, label=labels,
                                      instance=instances))
    return found, _regions(semantic, things)


def _regions(semantic: SemanticMesh, things: dict[int, Thing]) -> list[RoomOutline]:
    """Rooms of the regions: where their floors are. The files give them numbers, no names."""
    rooms = []
    region = np.array([things[int(code)].region if int(code) in things else -1
                       for code in semantic.colours])
    floors = {code for code, thing in things.items() if class_name(thing.category) == 'floor'}
    floor = np.isin(semantic.colours, list(floors))
    for number in sorted(set(region.tolist()) - {-1}):
        own = semantic.corners[(region == number) & floor]
        if len(own):
            every = semantic.corners[region == number][..., 2]
            rooms.append(RoomOutline(f'region {number}', f'region_{number}', list(own[..., :2]),
                                     float(own[..., 2].min()) - REGION_MARGIN,
                                     float(every.max()) + REGION_MARGIN))
    return rooms


def _region(entry: dict, scene: SceneName) -> RoomOutline:
    """A room of a region_annotation: its corners in Habitat's world."""
    try:
        loop = np.array(entry['poly_loop'], float)
        points = loop @ MAP[:3, :3].T
        low = float(entry.get('floor_height', points[:, 2].min()))
        high = low + float(entry.get('extrusion_height', 3.0))
        kind = class_name(str(entry['label']))
        return RoomOutline(str(entry.get('name', kind)), kind, [points[:, :2]],
                           low - REGION_MARGIN, high)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise UserError('a region has label and poly_loop (corners x, y, z)',
                        f'{scene}: {str(entry)[:60]}: {error}',
                        'take the data set as it was downloaded') from error


def _number(scene: SceneName, options: dict[str, str], name: str, default: float) -> float:
    """A positive number of an option."""
    try:
        value = float(options.get(name, default))
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise UserError(f'the option {name} is a positive number', str(scene), 'correct it')
    return value


def _doors(scene: SceneName, options: dict[str, str]) -> tuple[str, ...]:
    """Classes that are in nobody's way: doors, if they count as open."""
    doors = options.get('doors', 'as_drawn')
    if doors not in ('as_drawn', 'open'):
        raise UserError('doors are as_drawn or open', str(scene), 'choose one of them')
    return ('door',) if doors == 'open' else ()


SIMULATOR = GltfSimulator
