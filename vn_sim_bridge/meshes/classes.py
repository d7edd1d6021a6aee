"""Which classes meshes have: of a data set all of them, so that its scenes' numbers never vary."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vn_nav.errors import UserError
from vn_sim_bridge.meshes.habitat import ASSETS, Dataset, Template
from vn_sim_bridge.meshes.semantics import read_annotations
from vn_sim_bridge.meshes.vocabulary import Vocabulary
from vn_sim_bridge.notices import say_once

Files = tuple[Path, Path]  # .semantic.glb and .semantic.txt


def files_beside(path: Path) -> Files | None:
    """The semantic files that lie beside a stage; None: there are none."""
    stem = path.name.removesuffix(path.suffix).removesuffix('.basis')
    mesh, text = (path.parent / f'{stem}.semantic.{ending}' for ending in ('glb', 'txt'))
    if mesh.is_file() != text.is_file():
        say_once(f'{path.name}: of its two semantic files one is missing; it has no labels')
    return (mesh, text) if mesh.is_file() and text.is_file() else None


def files_of(stage: Template) -> Files | None:
    """The semantic files of a stage of a data set: named in its configuration, or beside it.

    Raises:
        UserError: one that is named is missing.
    """
    mesh = stage.asset('semantic_asset')
    text = stage.asset('semantic_descriptor_filename') or stage.asset('house_filename')
    if mesh is not None and text is not None and mesh.suffix in ASSETS:
        return mesh, text
    asset = stage.asset()
    return None if asset is None else files_beside(asset)


def file_classes(files: Files | None) -> set[str]:
    """The categories of semantic files.

    Raises:
        UserError: they cannot be read.
    """
    if files is None:
        return set()
    return {thing.category for thing in read_annotations(files[1]).values()}


def dataset_classes(dataset: Dataset) -> set[str]:
    """The categories of all that lies of a data set, whichever scenes are opened.

    What cannot be read of scenes that nobody has asked for is left out, and a line says so.
    """
    found, lost = dataset.class_names(), 0
    for name in dataset.stage_names():
        try:
            found |= file_classes(files_of(dataset.stage(name)))
        except UserError:  # said again, as an error, when the stage is opened
            lost += 1
    if lost:
        say_once(f'{dataset.path.name}: {lost} stages cannot be read; classes that only they have '
                 'are left out, and the numbers of classes may be others than with all of it')
    return found


def common_names(vocabularies: Sequence[Vocabulary], whose: Sequence[str]) -> tuple[str, ...]:
    """Names of the classes of all scenes of a simulator.

    Raises:
        UserError: a number means one class in one scene and another in another one.
    """
    most = max(range(len(vocabularies)), key=lambda k: len(vocabularies[k].names))
    names = vocabularies[most].names
    for own, scene in zip(vocabularies, whose, strict=True):
        if own.names != names[:len(own.names)]:
            raise UserError('scenes that are opened together number their classes alike',
                            f'{scene} and {whose[most]} have lists of their own', 'give one list '
                            'to all: labels=FILE, as docs/simulators/gltf.md says; scenes of one '
                            'data set have one')
    return names
