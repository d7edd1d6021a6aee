"""Which files a bag is made of, and which are recordings that have to be converted first.

A folder is read whole or refused: a file that is left out without a word is a drive cut short.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from vn_nav.bags.storage.input import Loss
from vn_nav.bags.storage.records import A_BAG, BagError

METADATA = 'metadata.yaml'
UNLISTED = 'metadata.yaml does not name it'
MAX_METADATA = 1 << 20  # bytes; a day of hourly files with a hundred topics has 200 kB
MAX_NESTED = 32  # brackets within brackets
UNPACK = {  # what compressed files as a whole, and what unpacks them beside themselves
    '.zst': 'zstd -d', '.zstd': 'zstd -d', '.gz': 'gunzip -k', '.bz2': 'bunzip2 -k',
    '.xz': 'unxz -k', '.lz4': 'lz4 -d -m'}
KINDS = {'.db3': 'a bag in SQLite', '.bag': 'a bag of ROS 1', '.mcap': 'an MCAP file'}


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

    A compressed file whose unpacked twin lies beside it is read by the twin, as `ros2 bag play`
    leaves them.

    Args:
        path: a rosbag2 folder or an MCAP file.
        strict: a metadata.yaml that is damaged, names a file that is not there, or does not name
            one that is there, is an error. Otherwise what is there is read, and `losses` tell.

    Raises:
        OtherFormat: a file in another format, alone or beside MCAP files.
        BagError: no such file or folder, or one without MCAP files.
    """
    path = Path(path)
    try:
        if not path.is_dir():
            if not path.exists():
                raise BagError(path, 'no such file or folder', rule=A_BAG,
                               remedy='give the path of a recording')
            _refuse_other_formats(path.parent, [path.name], alone=True)
            return BagFiles([path], [])
        names = sorted((file.name for file in path.iterdir() if file.is_file()), key=_by_number)
    except OSError as error:
        raise BagError(path, f'cannot be looked into ({error.strerror})', rule=A_BAG,
                       remedy='give the path of a recording') from error
    there = [path / name for name in names if Path(name).suffix.lower() == '.mcap']
    if METADATA not in names:
        _refuse_other_formats(path, names)
        if not there:
            raise BagError(path, 'holds no MCAP file', rule=A_BAG, remedy=_elsewhere(path))
        return BagFiles(there, [])  # the files tell all; the recorder may have been killed before
    try:
        information, listed = _listed(path, names)
    except OtherFormat:
        raise
    except BagError as error:
        _refuse_other_formats(path, names)
        if strict or not there:
            raise
        return BagFiles(there, [Loss(error.path, 0, 0, error.fault, harmless=True)])
    _refuse_other_formats(path, names)
    gone = [file for file in listed if file not in there and not file.is_file()]
    more = [file for file in there if file not in listed]
    whole = f'`vn_nav bag recover {shlex.quote(str(path))} NEW`'
    if gone and (strict or len(gone) == len(listed) and not more):
        raise BagError(gone[0], 'metadata.yaml names it, and it is not there', remedy='copy the '
                       f'bag again, or read what is left with {whole}' if there else
                       'copy the bag again: none of its files is there')
    if more and strict:
        raise BagError(more[0], UNLISTED, rule=A_BAG, remedy='put all that is there into one bag '
                       f'with {whole}, or move the file elsewhere')
    return BagFiles([file for file in listed if file not in gone] + more, [
        *(Loss(file, 0, 0, 'the file is not there') for file in gone),
        *(Loss(file, 0, 0, UNLISTED, harmless=True) for file in more)], *_origin(information))


def load_yaml(text: str) -> Any:
    """What a YAML text of a bag says.

    Raises:
        ValueError: what takes quadratic or exponential time to read, and no bag needs.
        Exception: many others; the text is nobody's to vouch for.
    """
    depth = deepest = 0
    for bracket in re.findall(r'[][{}]', text):
        depth += 1 if bracket in '[{' else -1
        deepest = max(deepest, depth)
    if deepest > MAX_NESTED or '<<' in text:
        raise ValueError('brackets within brackets, or merged mappings')
    return yaml.safe_load(text)


def converted(source: str | Path) -> str:
    """The command that writes a recording of another format as MCAP.

    Args:
        source: a file, a folder or a pattern of files.
    """
    source = Path(source)
    folder = source if source.suffix not in KINDS else (
        source.parent if '*' in source.name else source.with_suffix(''))
    if folder.name in ('', '..'):
        folder = folder.resolve()
    return (f'`rosbags-convert --src {_quoted(source)} --dst {_quoted(f"{folder}_mcap")} '
            '--dst-storage mcap`')


def _listed(folder: Path, names: list[str]) -> tuple[dict, list[Path]]:
    """What metadata.yaml says, and the files that it names, unpacked in place of compressed."""
    path = folder / METADATA
    try:
        if path.stat().st_size > MAX_METADATA:
            raise BagError(path, f'has more than {MAX_METADATA} bytes')
        information = load_yaml(path.read_text())['rosbag2_bagfile_information']
        listed = [str(name) for name in information['relative_file_paths']]
        mode, storage = (str(information.get(key) or '').lower()
                         for key in ('compression_mode', 'storage_identifier'))
    except BagError:
        raise
    except Exception as error:  # no end to what YAML can be instead
        raise BagError(path, f'is not the metadata of a bag ({type(error).__name__})',
                       remedy='take it away: the MCAP files tell all that is in it') from error
    for name in listed:
        if Path(name).name != name or name in ('', '..'):
            raise BagError(path, f'it names {name!r}, which is not within the folder',
                           remedy='correct relative_file_paths')
    anew = f'write the bag anew with {converted(folder)}'
    if mode == 'message':
        raise OtherFormat(path, 'its messages are compressed one by one', anew)
    if storage not in ('mcap', ''):
        raise OtherFormat(path, f'its storage is {storage!r}', anew)
    listed = [twin if (twin := _unpacked(name)) in names else name for name in listed]
    _refuse_other_formats(folder, listed)
    return information, [folder / name for name in listed]


def _origin(information: dict) -> tuple[str | None, dict[str, str] | None]:
    """The ROS distribution and the user's own data of a bag; None: it does not say."""
    distro, data = information.get('ros_distro'), information.get('custom_data')
    whole = isinstance(data, dict) and all(
        isinstance(word, (str, int, float)) for pair in data.items() for word in pair)
    return (distro if isinstance(distro, str) and distro.isprintable() else None,
            {str(key): str(value) for key, value in data.items()} if whole and data else None)


def _refuse_other_formats(folder: Path, names: list[str], alone: bool = False) -> None:
    """Refuse recordings in other formats among some files, with the command that converts.

    Args:
        folder: where they are.
        names: of the files.
        alone: it is one file that was asked for, and not its folder.
    """
    for name in names:
        twin = _unpacked(name)
        suffix = Path(twin or name).suffix.lower()
        if suffix not in KINDS or twin in names or suffix == '.mcap' and twin is None:
            continue
        if twin is not None:
            packed = Path(name).suffix
            pattern = folder / (name if alone else f'*{suffix}{packed}')
            remedy = f'unpack it with `{UNPACK[packed.lower()]} {_quoted(pattern)}`'
            what = f'{KINDS[suffix]} that is compressed as a whole'
        else:
            what = KINDS[suffix]
            remedy = f'write it anew with {converted(folder / (name if alone else "*" + suffix))}'
        if any(Path(other).suffix.lower() == '.mcap' for other in names):
            remedy += ', or give the path of one MCAP file to read that alone'
        raise OtherFormat(folder / name, what, remedy)


def _unpacked(name: str) -> str | None:
    """The name of a compressed recording without what compressed it; None: it is none."""
    inner, packed = Path(name).stem, Path(name).suffix.lower()
    return inner if packed in UNPACK and Path(inner).suffix.lower() in KINDS else None


def _elsewhere(folder: Path) -> str:
    """What to do about a folder without a recording."""
    within = sorted(path.parent.name for path in folder.glob(f'*/{METADATA}'))
    if within:
        return f'give the path of one recording in it, such as {_quoted(folder / within[0])}'
    return 'give the path of a recording'


def _by_number(name: str) -> list:
    return [(0, int(part), '') if part.isdecimal() else (1, 0, part)
            for part in re.split(r'([0-9]+)', name)]


def _quoted(path: str | Path) -> str:
    """A path for a shell, where a pattern stays one."""
    path = Path(path)
    if '*' not in path.name:
        return shlex.quote(str(path))
    return f'{shlex.quote(str(path.parent))}/{path.name}'
