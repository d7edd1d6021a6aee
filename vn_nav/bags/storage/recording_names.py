"""What a file is by its name: a recording, one that has to be converted first, or neither."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

KINDS = {'.db3': 'a bag in SQLite', '.bag': 'a bag of ROS 1', '.mcap': 'an MCAP file'}
UNPACK = {  # what compressed files as a whole, and what unpacks them into the same folder
    '.zst': 'zstd -d', '.zstd': 'zstd -d', '.gz': 'gunzip -k', '.bz2': 'bunzip2 -k',
    '.xz': 'unxz -k', '.lz4': 'lz4 -d -m'}
ARCHIVES = {  # the same for archives; the folder follows
    '.tar': ('tar -xf {file} -C {folder}'), '.tgz': ('tar -xf {file} -C {folder}'),
    '.zip': ('unzip {file} -d {folder}'), '.7z': ('7z x {file} -o{folder}')}
UNFINISHED = {'.active', '.part', '.partial', '.crdownload', '.download', '.filepart',
              '.incomplete', '.tmp', '.temp'}  # of recorders, browsers and copiers
ASIDE = {'.bak', '.old', '.orig', '.copy', '.save', '~'}
JOURNALS = ('-wal', '-shm', '-journal')  # of SQLite: what is not yet in the .db3 file
MAX_SPLITS = 10_000  # larger numbers in names are dates


class Recording(NamedTuple):
    """A file name with one of the endings of recordings in it."""

    kind: str  # of KINDS
    name: str  # up to that ending
    more: tuple[str, ...]  # further endings, in lower case; (): it is such a recording


def recording(name: str) -> Recording | None:
    """What a name says; None: nothing that concerns a bag (a README, a picture, a checksum)."""
    more: list[str] = []
    rest = name
    while rest:
        if rest.endswith('~'):
            rest, ending = rest[:-1], '~'
        else:
            suffix = Path(rest).suffix
            if suffix.lower() in KINDS:
                return Recording(suffix.lower(), rest, tuple(more[::-1]))
            journal = next((j for j in JOURNALS if suffix.lower() == f'.db3{j}'), None)
            ending = journal or suffix.lower()
            if not (journal or ending in UNPACK or ending in ARCHIVES or ending in UNFINISHED
                    or ending in ASIDE or re.fullmatch(r'\.[0-9]+', ending)):
                return None
            rest = rest[:-len(ending)]
        more.append(ending)
    return None


def has_twin(name: str, names: Iterable[str]) -> bool:
    """Whether the same file is among some names without its last ending, or the last ones."""
    found = recording(name)
    endings = [''.join(found.more[k:]) for k in range(len(found.more))] if found else [
        Path(name).suffix]
    shorter = {name[:-len(ending)] for ending in endings if ending}
    return not shorter.isdisjoint(names)


def conversion(path: Path, found: Recording, names: Iterable[str], alone: bool) -> tuple[str, str]:
    """What a recording that cannot be read as it is is, and what to do about it.

    Args:
        path: of the file.
        found: what its name says.
        names: of the other files there.
        alone: it is the one file that was asked for, and not its folder.
    """
    what, last = KINDS[found.kind], found.more[-1] if found.more else ''
    archive = next((ending for ending in reversed(found.more) if ending in ARCHIVES), None)
    if archive is not None:
        command = ARCHIVES[archive].format(file=shlex.quote(str(path)),
                                           folder=shlex.quote(str(path.parent)))
        return f'{what} in an archive', f'unpack it with `{command}`'
    if last in UNPACK:
        own = path.name[len(found.name) - len(found.kind):]  # its endings as they are written
        pattern = path if alone else path.with_name(f'*{own}')
        return (f'{what} that is compressed as a whole',
                f'unpack it with `{UNPACK[last]} {quoted(pattern)}`')
    if last in JOURNALS:
        return (f'a part of {what} whose .db3 file is not there',
                f'copy {shlex.quote(found.name)} next to it')
    if last in UNFINISHED:
        what += ' that is not finished, or whose recorder was killed'
        if found.kind == '.mcap':
            return what, ('save what is whole with `vn_nav bag recover '
                          f'{shlex.quote(str(path))} {quoted(path.with_name(found.name))}`')
        if found.kind == '.bag':
            return what, (f'close it with `rosbag reindex {shlex.quote(str(path))}` (ROS 1) and '
                          'take the last ending off its name')
        return what, 'finish its copy, and take the last ending off its name'
    if found.more:
        return f'{what} under another name', (
            f'rename it to {shlex.quote(found.name)}, or move it elsewhere')
    if alone and path.with_name(f'{path.name}-wal').exists():
        names = [*names, f'{path.name}-wal']
    source = path if alone else path.with_name(f'*{path.suffix}')
    return what, f'write it anew with {converted(source, names)}'


def converted(source: str | Path, names: Iterable[str] = ()) -> str:
    """The command that writes a recording of another format as MCAP.

    Args:
        source: a file, a folder or a pattern of files.
        names: of the files there. What SQLite keeps next to its files has to be put into them
            first: the converter looks at the .db3 files alone.
    """
    source = Path(source)
    folder = source if source.suffix.lower() not in KINDS else (
        source.parent if '*' in source.name else source.with_suffix(''))
    if folder.name in ('', '..'):
        folder = folder.resolve()
    place = source.parent if source.suffix.lower() in KINDS else source
    first = ''.join(
        f"sqlite3 {shlex.quote(str(place / name[:-4]))} 'PRAGMA wal_checkpoint(TRUNCATE)' && "
        for name in sorted(names) if name.lower().endswith('.db3-wal') and name[:-4] in names)
    return (f'`{first}rosbags-convert --src {quoted(source)} --dst {quoted(f"{folder}_mcap")} '
            '--dst-storage mcap`')


def quoted(path: str | Path) -> str:
    """A path for a shell, where a pattern stays one."""
    path = Path(path)
    if '*' not in path.name:
        return shlex.quote(str(path))
    return f'{shlex.quote(str(path.parent))}/{path.name}'


def absent_splits(folder: str, names: Iterable[str]) -> list[str]:
    """The files that are missing by the numbers of the others, as rosbag2 gives them: NAME_0, ...

    Between two numbers nothing may be missing; before the first one it may, unless the files are
    named as their folder, which is rosbag2's way: then they begin with 0. What came after the last
    one nobody can know.

    Args:
        folder: its name.
        names: of the MCAP files.
    """
    groups: dict[tuple[str, str], set[int]] = {}
    for name in names:
        found = re.fullmatch(r'(.*)_(0|[1-9][0-9]*)(\.[^.]*)', name)
        if found and len(found[2]) < 6 and int(found[2]) < MAX_SPLITS:
            groups.setdefault((found[1], found[3]), set()).add(int(found[2]))
    return [f'{name}_{k}{suffix}' for (name, suffix), numbers in groups.items()
            for k in range(0 if name == folder else min(numbers), max(numbers))
            if k not in numbers]
