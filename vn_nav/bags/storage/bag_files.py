"""Which files a bag is made of, and which are recordings that have to be converted first.

A folder is read whole or refused: a file that is left out silently is a drive cut short.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Container
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from vn_nav.bags.storage.input import Loss
from vn_nav.bags.storage.recording_names import (
    KINDS,
    absent_splits,
    conversion,
    converted,
    has_twin,
    quoted,
    recording,
)
from vn_nav.bags.storage.records import A_BAG, BagError
from vn_nav.bags.storage.summary import MAGIC

__all__ = ['METADATA', 'UNLISTED', 'BagFiles', 'OtherFormat', 'converted', 'files_of', 'load_yaml']

METADATA = 'metadata.yaml'
UNLISTED = 'metadata.yaml does not name it'
EMPTY = 'is empty'
MAX_METADATA_BYTES = 1 << 20  # bytes; a day of hourly files with a hundred topics has 200 kB
MAX_NESTED = 32  # brackets within brackets
FIRST_BYTES = {MAGIC: '.mcap', b'#ROSBAG V': '.bag'}  # of recordings, whatever their names


class OtherFormat(BagError):
    """A recording that is not damaged but in another format: the remedy is the conversion."""

    def __init__(self, path: str | Path, what: str, remedy: str):
        super().__init__(path, what, rule=A_BAG, remedy=remedy)


class BagFiles(NamedTuple):
    """The MCAP files of a bag in the order of recording."""

    paths: list[Path]
    losses: list[Loss]  # what is not there, or not as metadata.yaml says
    ros_distro: str | None = None  # as metadata.yaml has it
    custom_data: dict[str, str] | None = None  # likewise: what the user wrote there


def files_of(path: str | Path, *, strict: bool = True) -> BagFiles:
    """The files of a bag: as its metadata.yaml has them, or by their numbers.

    Whatever in the folder is a recording by its name or its first bytes is read or refused; hidden
    files, and folders within, are ignored. A file whose twin without the last ending lies
    next to it (unpacked, or finished) is read by the twin, as `ros2 bag play` leaves them.

    Args:
        path: a rosbag2 folder or an MCAP file.
        strict: a metadata.yaml that is damaged, names a file that is not there, or does not name
            one that is there, is an error, and so is an MCAP file that cannot be opened, is empty,
            or is missing by the numbers of the others. Otherwise what is there is read, and
            `losses` list.

    Raises:
        OtherFormat: a file in another format, alone or among MCAP files.
        BagError: no such file or folder, or one without MCAP files.
    """
    path = Path(path)
    try:
        if not path.is_dir():
            if not os.path.lexists(path):
                raise BagError(path, 'no such file or folder', rule=A_BAG,
                               remedy='give the path of a recording')
            _refuse_other_formats(path.parent, [path.name], alone=True)
            if (fault := _fault(path)) is not None and (strict or fault[0] != EMPTY):
                raise BagError(path, fault[0], rule=A_BAG, remedy=fault[1])
            return BagFiles([path], [])
        names = sorted((name for name in os.listdir(path) if not name.startswith('.')),
                       key=_by_number)
        faults = {path / name: fault for name in names if Path(name).suffix.lower() == '.mcap'
                  and (fault := _fault(path / name)) is not None}
        folders = [name for name in names if (path / name).is_dir()]
    except OSError as error:
        raise BagError(path, f'cannot be opened ({error.strerror})', rule=A_BAG,
                       remedy='give the path of a recording') from error
    there = [file for name in names if (file := path / name) not in faults
             and file.suffix.lower() == '.mcap']
    if not there:  # then a folder may be a bag of its own, whatever its name
        faults = {file: fault for file, fault in faults.items() if file.name not in folders}
    names = [name for name in names if name not in folders]
    whole = f'`vn_nav bag recover {shlex.quote(str(path))} NEW`'
    rest = f', or read what is left with {whole}' if there else ''
    if METADATA not in names:
        _refuse_other_formats(path, names)
        if not there and not faults:
            raise BagError(path, 'holds no MCAP file', rule=A_BAG, remedy=_elsewhere(path))
        losses = _unreadable(path, there, faults, rest, strict or not there)
        return BagFiles(there, losses)  # the files show all; the recorder may have been killed
    try:
        information, listed = _listed(path, names)
    except OtherFormat:
        raise
    except BagError as error:
        _refuse_other_formats(path, names)
        if strict or not there:
            raise
        return BagFiles(there, [Loss(error.path, 0, 0, error.fault, harmless=True),
                                *_unreadable(path, there, faults, rest, strict)])
    _refuse_other_formats(path, names, listed=[file.name for file in listed])
    gone = [file for file in listed if file not in faults and not file.is_file()]
    more = [file for file in there if file not in listed]
    if gone and (strict or len(gone) == len(listed) and not more):
        raise BagError(gone[0], 'metadata.yaml names it, and it is not there', remedy=(
            f'copy the bag again{rest}' if there else
            'copy the bag again: none of its files is there'))
    losses = _unreadable(path, [], faults, rest, strict or not there)
    if more and strict:
        raise BagError(more[0], UNLISTED, rule=A_BAG, remedy='put all that is there into one bag '
                       f'with {whole}, or move the file elsewhere')
    return BagFiles([file for file in listed if file not in gone and file not in faults] + more, [
        *(Loss(file, 0, 0, 'the file is not there') for file in gone), *losses,
        *(Loss(file, 0, 0, UNLISTED, harmless=True) for file in more)], *_origin(information))


def _fault(path: Path) -> tuple[str, str] | None:
    """Why a file cannot be read, and what to do; None: it can, whatever is in it."""
    if path.is_symlink() and not path.exists():
        return (f'is a link to {os.readlink(path)}, which is not there',
                'copy the bag with what its links point at (`cp -rL`)')
    if path.is_dir():
        return 'is a folder', 'move it elsewhere, or give its own path'
    if not path.is_file():
        return 'is not a file', 'give the path of a recording'
    try:
        with open(path, 'rb') as file:
            return None if file.read(1) else (EMPTY, 'copy it again, or take it away')
    except OSError as error:
        return f'cannot be read ({error.strerror})', 'check its permissions and its disk'


def _unreadable(folder: Path, numbered: list[Path], faults: dict[Path, tuple[str, str]],
                rest: str, strict: bool) -> list[Loss]:
    """The MCAP files that cannot be read, and those that are missing between the others.

    Args:
        folder: of the bag.
        numbered: files whose numbers imply others.
        faults: of those that cannot be read.
        rest: remedy that reads the others.
        strict: they are an error.

    Raises:
        BagError: there is such a file, if strict.
    """
    found = [(file, *fault) for file, fault in faults.items()]
    if numbered:
        found += [(folder / name, 'is not there, by the numbers of the others',
                   'copy the bag again') for name in absent_splits(
                       folder.resolve().name, [file.name for file in (*numbered, *faults)])]
    if found and strict:
        raise BagError(found[0][0], found[0][1], rule=A_BAG, remedy=found[0][2] + rest)
    return [Loss(file, 0, 0, what, harmless=what == EMPTY) for file, what, _ in found]


def load_yaml(text: str) -> Any:
    """What a YAML text of a bag says.

    Raises:
        ValueError: what takes quadratic or exponential time to read, and no bag needs.
        Exception: many others; the text is untrusted.
    """
    depth = deepest = 0
    for bracket in re.findall(r'[][{}]', text):
        depth += 1 if bracket in '[{' else -1
        deepest = max(deepest, depth)
    if deepest > MAX_NESTED or '<<' in text:
        raise ValueError('brackets within brackets, or merged mappings')
    return yaml.safe_load(text)


def _listed(folder: Path, names: list[str]) -> tuple[dict, list[Path]]:
    """What metadata.yaml says, and the files that it names, unpacked in place of compressed."""
    path = folder / METADATA
    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            raise BagError(path, f'has more than {MAX_METADATA_BYTES} bytes')
        information = load_yaml(path.read_text())['rosbag2_bagfile_information']
        listed = [str(name) for name in information['relative_file_paths']]
        mode, storage = (str(information.get(key) or '').lower()
                         for key in ('compression_mode', 'storage_identifier'))
    except BagError:
        raise
    except Exception as error:  # no end to what YAML can be instead
        raise BagError(path, f'is not the metadata of a bag ({type(error).__name__})',
                       remedy='take it away: the MCAP files hold all of its content') from error
    for name in listed:
        if Path(name).name != name or name in ('', '..'):
            raise BagError(path, f'it names {name!r}, which is outside the folder',
                           remedy='correct relative_file_paths')
    anew = f'write the bag anew with {converted(folder, names)}'
    if mode == 'message':
        raise OtherFormat(path, 'its messages are compressed one by one', anew)
    if storage not in ('mcap', ''):
        raise OtherFormat(path, f'its storage is {storage!r}', anew)
    listed = [found.name if (found := recording(name)) and found.name in names else name
              for name in listed]
    _refuse_other_formats(folder, listed, listed=listed)
    return information, [folder / name for name in listed]


def _origin(information: dict) -> tuple[str | None, dict[str, str] | None]:
    """The ROS distribution and the user's own data of a bag; None: it does not say."""
    distro, data = information.get('ros_distro'), information.get('custom_data')
    whole = isinstance(data, dict) and all(
        isinstance(part, (str, int, float)) for pair in data.items() for part in pair)
    return (distro if isinstance(distro, str) and distro.isprintable() else None,
            {str(key): str(value) for key, value in data.items()} if whole and data else None)


def _refuse_other_formats(folder: Path, names: list[str], alone: bool = False,
                          listed: Container[str] = ()) -> None:
    """Refuse recordings that are not read as they are, with the command that makes them readable.

    Args:
        folder: where they are.
        names: of the files.
        alone: it is one file that was asked for, and not its folder: if it begins as an MCAP file
            it is read, though it may not be finished.
        listed: names that metadata.yaml has, whatever they are.
    """
    for name in names:
        path, found = folder / name, recording(name)
        if (found and found.kind == '.mcap' and not found.more or has_twin(name, names)
                or found is None and name in listed):
            continue
        fault = _fault(path) if found and os.path.lexists(path) else None
        if fault is not None and fault[0] != EMPTY:
            raise OtherFormat(path, *fault)
        begins = None if found and found.kind != '.mcap' else _first_bytes(path)
        if alone and (begins == '.mcap' or found is None):
            continue
        if found is not None:
            what, remedy = conversion(path, found, names, alone)
        elif begins is not None:
            what = f'{KINDS[begins]} by its first bytes, under another name'
            remedy = f'rename it to NAME{begins}, or move it elsewhere'
        else:
            continue
        if any(Path(other).suffix.lower() == '.mcap' for other in names):
            remedy += ', or give the path of one MCAP file to read that alone'
        raise OtherFormat(path, what, remedy)


def _first_bytes(path: Path) -> str | None:
    """The kind of recording that a file begins as; None: none, or it cannot be looked into."""
    try:
        if path.is_file():
            with open(path, 'rb') as file:
                begin = file.read(16)
            return next((kind for bytes_, kind in FIRST_BYTES.items()
                         if begin.startswith(bytes_)), None)
    except OSError:
        pass
    return None


def _elsewhere(folder: Path) -> str:
    """What to do about a folder without a recording."""
    within = sorted(path.parent.name for path in folder.glob(f'*/{METADATA}'))
    if within:
        return f'give the path of one recording in it, such as {quoted(folder / within[0])}'
    return 'give the path of a recording'


def _by_number(name: str) -> list:
    return [(0, int(part), '') if part.isdecimal() else (1, 0, part)
            for part in re.split(r'([0-9]+)', name)]
