"""Habitat's data sets: `.scene_dataset_config.json` and what it refers to, as surfaces and rooms.

Habitat's world has y up and -z to the front. What is static is read: stage, objects, semantic
files, regions. Articulated objects (URDF), lights and physics are not, and a line says so.
"""

from __future__ import annotations

import csv
import dataclasses
import fnmatch
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.meshes.parts import MAP, axes
from vn_sim_bridge.notices import say_once

SUFFIX = '.scene_dataset_config.json'
ASSETS = ('.glb', '.gltf', '.obj')
REMEDY = 'take the data set as it was downloaded'
ID_COLUMNS = ('id', 'name', 'object_id')
CATEGORY_COLUMNS = ('main_category', 'clean_category', 'category', 'semantic_category')


@dataclasses.dataclass(frozen=True)
class Template:
    """A stage or an object: its attributes, and the folder that their paths start from."""

    name: str
    attributes: dict[str, Any]
    folder: Path

    def asset(self, key: str = 'render_asset') -> Path | None:
        """The file of an attribute; None: it has none.

        Raises:
            UserError: it does not exist.
        """
        value = self.attributes.get(key)
        if not value:
            return None
        path = self.folder / str(value)
        if not path.is_file():
            raise UserError(f'the {key} of {self.name} exists', str(path), REMEDY)
        return path

    def matrix(self, semantic: bool = False) -> np.ndarray:
        """[4,4] from the asset's axes and units to Habitat's world."""
        own = self.attributes
        up, front = own.get('up', (0, 1, 0)), own.get('front', (0, 0, -1))
        if semantic:
            up = own.get('semantic_up', own.get('semantic_orient_up', up))
            front = own.get('semantic_front', own.get('semantic_orient_front', front))
        found = np.eye(4)
        scale = np.array(own.get('scale', (1, 1, 1)), float) * float(
            own.get('units_to_meters', 1.0))
        found[:3, :3] = axes(up, front, self.name) @ np.diag(scale)
        if np.any(own.get('origin', (0, 0, 0))):
            say_once(f'{self.name}: "origin" of a stage is left out, as Habitat does')
        return found


@dataclasses.dataclass(frozen=True)
class Instance:
    """A stage or an object that stands in a scene."""

    template: Template
    matrix: np.ndarray  # [4,4] from the asset to the map frame
    by_middle: bool  # it is placed by the middle of its bounding box, not by its origin


@dataclasses.dataclass(frozen=True)
class SceneParts:
    """What a scene is made of."""

    stage: Instance
    objects: list[Instance]
    regions: list[dict]  # region_annotations
    classes: dict[int, str]  # of semantic ids


class Dataset:
    """A data set's configuration. Files of single scenes are read when they are asked for.

    Args:
        path: of the .scene_dataset_config.json file.

    Raises:
        UserError: no such file, or none of this kind.
    """

    def __init__(self, path: Path):
        self.path, self.root = path, path.parent
        self._json = read_object(path)
        self._stages = self._index('stages', '.stage_config.json')
        self._objects = self._index('objects', '.object_config.json')
        self._scenes = self._index('scene_instances', '.scene_instance.json')
        if not self._scenes and not self._stages:
            raise UserError('a scene data set has scene instances or stages',
                            f'{path}: none of the paths in it leads to one', REMEDY)
        self._categories: dict[str, str] | None = None

    def names(self, pattern: str = '*') -> list[str]:
        """Scenes, by name: the scene instances, else the stages."""
        known = self._scenes or self._stages
        return sorted(name for name in known if fnmatch.fnmatchcase(name, pattern))

    def _index(self, kind: str, suffix: str) -> dict[str, tuple[Path | None, dict]]:
        """Files and attributes of one kind, by name."""
        section = self._json.get(kind, {})
        if not isinstance(section, dict):
            return {}
        found: dict[str, tuple[Path | None, dict]] = {}
        for pattern in (entry for entries in section.get('paths', {}).values()
                        for entry in entries):
            for path in sorted(self.root.glob(str(pattern).rstrip('/'))):
                inside = sorted(path.iterdir()) if path.is_dir() else [path]
                for file in inside:
                    if file.name.endswith(suffix):
                        found[file.name[:-len(suffix)]] = file, {}
                    elif file.suffix in ASSETS and kind != 'scene_instances' and (
                            '.semantic.' not in file.name):
                        found.setdefault(file.name[:-len(file.suffix)],
                                         (None, {'render_asset': str(file)}))
        for entry in section.get('configs', ()):
            own, given = dict(entry.get('attributes', {})), entry.get('original_file')
            name = str(entry.get('template_handle') or Path(str(given)).name)
            name = name.removesuffix(suffix)
            found[name] = (self.root / given if given else None), own
        return found

    def stage_names(self) -> list[str]:
        """All stages, by name."""
        return sorted(self._stages)

    def stage(self, name: str) -> Template:
        """A stage.

        Raises:
            UserError: there is none of that name, or its configuration cannot be read.
        """
        return self._template(name, self._stages, 'stage')

    def _template(self, name: str, known: dict, kind: str) -> Template:
        """A stage or object by the name that scenes give it: with or without its folder."""
        short = str(name).split('/')[-1]
        for ending in ('.stage_config.json', '.object_config.json', *ASSETS):
            short = short.removesuffix(ending)
        if short not in known:
            raise UserError(f'every {kind} that a scene names is in its data set',
                            f'{self.path}: {name}', REMEDY)
        path, own = known[short]
        defaults = self._json.get(f'{kind}s', {}).get('default_attributes', {})
        if path is None:
            return Template(short, {**defaults, **own}, self.root)
        return Template(short, {**defaults, **read_object(path), **own}, path.parent)

    def category(self, template: Template, classes: dict[int, str]) -> str | None:
        """The class of an object: by its semantic id, else by a table of the data set."""
        number = template.attributes.get('semantic_id')
        if number and int(number) in classes:
            return classes[int(number)]
        return self.categories().get(template.name)

    def categories(self) -> dict[str, str]:
        """Classes of objects by name, from CSV tables in the folders metadata and semantics."""
        if self._categories is None:
            self._categories = {}
            for path in sorted([*self.root.glob('metadata/*.csv'),
                                *self.root.glob('semantics/*.csv')]):
                with path.open(encoding='utf-8', newline='') as file:
                    rows = csv.DictReader(file)
                    columns = rows.fieldnames or ()
                    key = next((name for name in ID_COLUMNS if name in columns), None)
                    value = next((name for name in CATEGORY_COLUMNS if name in columns), None)
                    if key and value:
                        self._categories.update((row[key], row[value]) for row in rows
                                                if row[key] and row[value])
        return self._categories

    def class_names(self) -> set[str]:
        """Classes of objects and semantic ids, of all scenes."""
        section = self._json.get('semantic_scene_descriptor_instances', {})
        named = [self.root / value for value in section.values() if isinstance(value, str)]
        return {*self.categories().values(), *(
            name for path in [*self._lexicons, *named, *self._descriptors()] if path.is_file()
            for name in _classes(read_object(path)).values())}

    @functools.cached_property
    def _lexicons(self) -> list[Path]:
        return sorted([*self.root.glob('semantics/*lexicon*.json'),
                       *self.root.glob('configs/ssd/*lexicon*.json')])

    def _descriptors(self) -> list[Path]:
        """Files of scenes' semantic descriptors that patterns lead to."""
        section = self._json.get('semantic_scene_descriptor_instances', {})
        return [path for patterns in section.get('paths', {}).values() for pattern in patterns
                for found in sorted(self.root.glob(str(pattern).rstrip('/')))
                for path in (sorted(found.iterdir()) if found.is_dir() else [found])
                if path.name.endswith('.semantic_config.json')]

    def scene(self, name: str) -> SceneParts:
        """What a scene is made of.

        Raises:
            UserError: there is no such scene, or something of it is missing.
        """
        if name not in self.names():
            listed = self.names()
            raise UserError(f'a scene of {self.path.name} is one of {len(listed)}: '
                            f'{", ".join(listed[:5])}{", ..." if len(listed) > 5 else ""}', name,
                            'choose one with scene=NAME, or some with scene=00*')
        if name not in self._scenes:
            return self._whole({}, name)
        path, own = self._scenes[name]
        return self._whole({**(read_object(path) if path else {}), **own}, name)

    def _whole(self, scene: dict, name: str) -> SceneParts:
        placed = scene.get('stage_instance', {'template_name': name})
        if not isinstance(placed, dict) or 'template_name' not in placed:
            raise UserError('a scene has a stage', f'{self.path}: {name}', REMEDY)
        origin = str(scene.get('translation_origin', 'unknown'))
        stage = _placed(self.stage(placed['template_name']), placed, 'asset_local')
        objects = [_placed(self._template(entry['template_name'], self._objects, 'object'), entry,
                           origin) for entry in scene.get('object_instances', ())]
        if left := scene.get('articulated_object_instances'):
            say_once(f'{name}: {len(left)} articulated objects (URDF) are left out')
        regions, classes = self._semantics(scene)
        return SceneParts(stage, objects, regions, classes)

    def _semantics(self, scene: dict) -> tuple[list[dict], dict[int, str]]:
        """Regions and classes of semantic ids of a scene's descriptor."""
        named = scene.get('semantic_scene_instance')
        section = self._json.get('semantic_scene_descriptor_instances', {})
        files: list[Path] = []
        if named:
            handle = str(named).split('/')[-1].removesuffix('.semantic_config.json')
            direct = section.get(named)
            files = [self.root / direct] if isinstance(direct, str) else [
                path for path in self._descriptors()
                if path.name == f'{handle}.semantic_config.json']
        regions: list[dict] = []
        classes: dict[int, str] = {}
        for path in [*self._lexicons, *(path for path in files if path.is_file())]:
            found = read_object(path)
            regions += found.get('region_annotations', [])
            classes.update(_classes(found))
        return regions, classes


def _classes(descriptor: dict) -> dict[int, str]:
    """Names of semantic ids that a file gives."""
    return {int(entry['id']): str(entry['name']) for entry in descriptor.get('classes', ())
            if isinstance(entry, dict) and {'id', 'name'} <= entry.keys()}


def _placed(template: Template, entry: dict, origin: str) -> Instance:
    """A template where an instance's entry puts it."""
    world = np.eye(4)
    w, x, y, z = np.array(entry.get('rotation', (1, 0, 0, 0)), float)
    length = np.sqrt(w * w + x * x + y * y + z * z)
    if not 1e-6 < length < np.inf:
        raise UserError('a rotation is a quaternion w, x, y, z',
                        f'{template.name}: {[w, x, y, z]}', REMEDY)
    w, x, y, z = np.array([w, x, y, z]) / length
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])
    scale = np.array(entry.get('non_uniform_scale', (1, 1, 1)), float) * float(
        entry.get('uniform_scale', 1.0))
    world[:3, :3] = turn @ np.diag(scale)
    world[:3, 3] = entry.get('translation', (0, 0, 0))
    own = template.matrix()
    middle = str(entry.get('translation_origin', origin)).lower() != 'asset_local'
    centre = template.attributes.get('COM')
    if middle and centre is not None:
        shift = np.eye(4)
        shift[:3, 3] = -np.array(centre, float)
        own, middle = own @ shift, False
    return Instance(template, MAP @ world @ own, middle)


def read_object(path: Path) -> dict:
    """A JSON object out of a file.

    Raises:
        UserError: no file, or another content.
    """
    try:
        found = json.loads(path.read_text('utf-8-sig'))
    except FileNotFoundError as error:
        raise UserError('a file of a scene data set exists', str(path), REMEDY) from error
    except (OSError, ValueError, RecursionError) as error:
        raise UserError('a file of a scene data set is JSON', f'{path}: {error}',
                        REMEDY) from error
    if not isinstance(found, dict):
        raise UserError('a file of a scene data set is a JSON object', str(path), REMEDY)
    return found
