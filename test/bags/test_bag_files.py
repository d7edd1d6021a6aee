"""A bag's folder is read whole or refused, with a command that really converts it."""

import contextlib
import gzip
import os
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import zstandard
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from small_bags import STORE, STRING, drive, make, serialised, write

from vn_nav import cli
from vn_nav.bags.dataset import Wanted
from vn_nav.bags.doctor.checks import diagnose
from vn_nav.bags.doctor.recover import recover
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.storage.stream import Bag, BagError, messages, summary
from vn_nav.robot import RobotSpec

SENT = drive(2.0)
METADATA = ('rosbag2_bagfile_information: {relative_file_paths: [%s], compression_mode: "%s", '
            'storage_identifier: mcap}')


def splits(folder, packed=None):
    """Three files of a drive; the first two packed as a whole."""
    folder.mkdir()
    for k in range(3):
        path = write(folder / f'r_{k}.mcap', SENT[k * len(SENT) // 3:(k + 1) * len(SENT) // 3])
        if packed is not None and k < 2:
            data = path.read_bytes()
            (folder / f'r_{k}.mcap{packed}').write_bytes(
                gzip.compress(data) if packed == '.gz' else zstandard.compress(data))
            path.unlink()
    return folder


def recorded(folder, plugin, mode=None):
    """A bag of rosbag2, with its metadata.yaml."""
    bag = Ros2Writer(folder, version=9, storage_plugin=plugin)
    if mode is not None:
        bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        known = {}
        for topic, kind, time, message in SENT:
            if topic not in known:
                known[topic] = bag.add_connection(topic, kind, typestore=STORE)
            bag.write(known[topic], time, serialised(kind, message))
    return folder


def ros1(path):
    """A bag of ROS 1 with one topic."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(path) as bag:
        topic = bag.add_connection('/words', STRING, typestore=store)
        for k in range(3):
            bag.write(topic, 10**18 + k, store.serialize_ros1(
                store.types[STRING](data=f'{k}'), STRING))
    return path


def refusal(path, words):
    """The one error of every way into a bag."""
    for read in (Bag, summary, diagnose, lambda path: Bag(path, strict=False),
                 lambda path: list(messages(path)),
                 lambda path: recover(path, path.parent / 'recovered'),
                 lambda path: load_drives(path, Wanted(RobotSpec()), path.parent / 'cache')):
        with pytest.raises(BagError, match=words) as error:
            read(path)
    assert not (path.parent / 'recovered').exists()
    return error.value


@pytest.mark.parametrize('beside', ['.mcap.zst', '.mcap.zstd', '.mcap.gz', '.db3', '.bag',
                                    '.db3.zstd', '.bag.bz2'])
@pytest.mark.parametrize('listed', [False, True])
def test_a_recording_in_another_format_beside_mcap_files_is_refused(tmp_path, beside, listed):
    folder = splits(tmp_path / 'bag')
    if listed:
        names = 'r_0.mcap, r_1.mcap, r_2.mcap'
        (folder / 'metadata.yaml').write_text(METADATA % (names, ''))
    Bag(folder)
    (folder / f'r_3{beside}').write_bytes(b'whatever')
    error = refusal(folder, re.escape(f'r_3{beside}'))
    assert '`' in error.remedy and 'one MCAP file to read that alone' in error.remedy
    assert len(list(Bag(folder / 'r_0.mcap').messages())) == len(SENT) // 3  # asked for alone


@pytest.mark.slow
@pytest.mark.parametrize('packed', ['.zst', '.zstd', '.gz'])
@pytest.mark.parametrize('listed', [False, True])
def test_packed_splits_are_read_once_the_command_has_unpacked_them(tmp_path, packed, listed):
    folder = splits(tmp_path / 'my bag', packed)
    if listed:
        (folder / 'metadata.yaml').write_text(METADATA % (
            f'r_0.mcap{packed}, r_1.mcap{packed}, r_2.mcap', 'FILE'))
    command = re.search('`(.*)`', refusal(folder, 'compressed as a whole').remedy).group(1)
    if shutil.which(command.split()[0]) is None:
        pytest.skip(f'expected: {command.split()[0]} is not installed')
    subprocess.run(['sh', '-c', command], check=True, capture_output=True)
    assert len(list(folder.glob(f'*{packed}'))) == 2  # the packed ones may stay
    assert len(list(messages(folder))) == len(SENT) == sum(
        topic.count for topic in diagnose(folder).topics)


@pytest.mark.slow
@pytest.mark.parametrize('kind', ['db3', 'db3 alone', 'db3 packed', 'message', 'bag'])
def test_the_command_that_an_error_names_converts(tmp_path, kind):
    folder = tmp_path / 'my bag'
    if kind == 'bag':
        folder.mkdir()
        path, count = ros1(folder / 'x.bag'), 3
    else:
        plugin = StoragePlugin.MCAP if kind == 'message' else StoragePlugin.SQLITE3
        mode = {'message': CompressionMode.MESSAGE, 'db3 packed': CompressionMode.FILE}.get(kind)
        path, count = recorded(folder, plugin, mode), len(SENT)
        if kind == 'db3 alone':
            (folder / 'metadata.yaml').unlink()
    for place in (path, folder):
        command = re.search('`(.*)`', refusal(place, 'a bag is a folder').remedy).group(1)
        words = shlex.split(command)
        assert words[0] == 'rosbags-convert'
        target = Path(words[words.index('--dst') + 1])
        program = Path(sys.executable).with_name('rosbags-convert')
        subprocess.run(['sh', '-c', command.replace('rosbags-convert', str(program), 1)],
                       check=True, capture_output=True)
        assert len(list(messages(target))) == count
        shutil.rmtree(target)


def test_metadata_that_does_not_name_what_is_there_is_an_error_and_recover_takes_all(tmp_path):
    folder = splits(tmp_path / 'bag')
    for names in ('r_0.mcap', 'r_0.mcap, r_2.mcap', ''):
        (folder / 'metadata.yaml').write_text(METADATA % (names, ''))
        with pytest.raises(BagError, match='does not name it') as error:
            Bag(folder)
        assert f'vn_nav bag recover {folder} NEW' in error.value.remedy
        assert any('does not name it' in f.what for f in diagnose(folder).findings)
        recovered = recover(folder, tmp_path / f'out{len(names)}')
        assert sum(recovered.counts.values()) == len(SENT) and not recovered.lost


def test_metadata_that_names_what_is_not_there_is_an_error_and_recover_says_what_is_lost(tmp_path):
    folder = splits(tmp_path / 'bag')
    (folder / 'metadata.yaml').write_text(METADATA % ('r_0.mcap, r_1.mcap, r_2.mcap', ''))
    (folder / 'r_1.mcap').unlink()
    with pytest.raises(BagError, match='r_1.mcap: metadata.yaml names it.*vn_nav bag recover'):
        Bag(folder)
    recovered = recover(folder, tmp_path / 'out')
    assert recovered.lost and any('r_1.mcap' in line for line in recovered.lines())
    for path in folder.glob('*.mcap'):
        path.unlink()
    refusal(folder, 'none of its files is there')


@pytest.mark.parametrize('command', [
    ['bag', 'doctor'], ['bag', 'recover'], ['bag', 'show'], ['teach'], ['pretrain']],
    ids=' '.join)
def test_every_command_prints_the_remedy(tmp_path, capsys, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'sqlite').mkdir()
    (tmp_path / 'sqlite' / 'x_0.db3').write_bytes(b'')
    (tmp_path / 'many' / 'one').mkdir(parents=True)
    (tmp_path / 'many' / 'one' / 'metadata.yaml').write_text('')
    for bag, words in (('sqlite', 'rosbags-convert --src sqlite/*.db3 --dst sqlite_mcap'),
                       ('mistyped', 'no such file or folder'),
                       ('many', 'such as many/one')):
        rest = {'recover': ['out'], 'teach': ['--out', 'out'], 'pretrain': ['--out', 'out']}
        assert cli.main([*command, bag, *rest.get(command[-1], [])]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert words in line and line.startswith('vn_nav: a bag is a folder')
    assert not (tmp_path / 'out').exists() or not any((tmp_path / 'out').iterdir())


@pytest.mark.parametrize('name, words', [
    ('r_3.bag.active', 'rosbag reindex'), ('r_3.mcap.active', 'vn_nav bag recover'),
    ('r_3.mcap.part', 'vn_nav bag recover'), ('r_3.MCAP.crdownload', 'vn_nav bag recover'),
    ('r_3.db3-wal', 'copy r_3.db3 next to it'), ('r_3.db3.part', 'finish its copy'),
    ('r_3.mcap.tar.gz', 'tar -xf'), ('r_3.mcap.tgz', 'tar -xf'), ('r_3.mcap.zip', 'unzip'),
    ('r_3.mcap.7z', '7z x'), ('r_3.mcap.bak', 'rename it'), ('r_3.mcap.1', 'rename it'),
    ('r_3.mcap~', 'rename it'), ('r_3.MCAP.ZST', r'zstd -d .*/\*\.MCAP\.ZST'),
    ('r_3.DB3', r'rosbags-convert --src .*/\*\.DB3 --dst .*bag_mcap')])
@pytest.mark.parametrize('listed', [False, True])
def test_unfinished_and_packed_recordings_are_refused_by_name(tmp_path, name, words, listed):
    folder = splits(tmp_path / 'bag')
    if listed:
        (folder / 'metadata.yaml').write_text(METADATA % ('r_0.mcap, r_1.mcap, r_2.mcap', ''))
    Bag(folder)
    (folder / name).write_bytes(b'whatever')
    error = refusal(folder, re.escape(name))
    assert re.search(words, error.remedy) and 'one MCAP file to read that alone' in error.remedy
    if '.mcap.' in name:  # the finished or unpacked one is there: this is its copy
        (folder / name).rename(folder / name.replace('r_3', 'r_2'))
        assert len(list(messages(folder))) == len(SENT)


def test_a_recording_is_known_by_its_first_bytes(tmp_path):
    folder = splits(tmp_path / 'bag')
    (folder / 'r_2.mcap').rename(folder / 'r_2.uploading')
    refusal(folder, 'r_2.uploading: an MCAP file by its first bytes.*rename it')
    listed = folder / 'metadata.yaml'
    listed.write_text(METADATA % ('r_0.mcap, r_1.mcap, r_2.uploading', ''))
    assert len(list(messages(folder))) == len(SENT)  # it is a name that somebody gave it
    listed.unlink()
    (folder / 'r_2.uploading').rename(folder / 'third')
    refusal(folder, 'third: an MCAP file by its first bytes')
    ros1(folder / 'x.bag').rename(folder / 'third')
    refusal(folder, 'third: a bag of ROS 1 by its first bytes')


def test_what_recover_saves_of_an_unfinished_file_is_read_with_the_others(tmp_path):
    folder = splits(tmp_path / 'my bag')
    last = folder / 'r_2.mcap'
    (folder / 'r_2.mcap.active').write_bytes(last.read_bytes()[:-60])  # without its end
    last.unlink()
    remedy = refusal(folder, 'r_2.mcap.active').remedy
    words = shlex.split(re.search('`(.*?)`', remedy).group(1))
    assert words[:3] == ['vn_nav', 'bag', 'recover'] and cli.main(words[1:]) == 0
    assert len(list(messages(folder))) == len(SENT)


def cannot_be_read(folder, kind):
    """A folder whose r_1.mcap is there and cannot be read."""
    path = splits(folder) / 'r_1.mcap'
    if kind in ('link', 'folder', 'pipe'):
        path.unlink()
    if kind == 'link':
        path.symlink_to('/gone/r_1.mcap')
    elif kind == 'folder':
        path.mkdir()
    elif kind == 'pipe':
        os.mkfifo(path)  # reading it would never end
    elif kind == 'empty':
        path.write_bytes(b'')
    return path


@pytest.mark.parametrize('listed', [False, True])
@pytest.mark.parametrize('kind, words', [
    ('link', 'is a link to /gone/r_1.mcap, which is not there.*cp -rL'), ('folder', 'is a folder'),
    ('pipe', 'is not a file'), ('empty', 'is empty')])
def test_a_file_that_cannot_be_read_is_named(tmp_path, kind, words, listed):
    path = cannot_be_read(tmp_path / 'bag', kind)
    if listed:
        (path.parent / 'metadata.yaml').write_text(
            METADATA % ('r_0.mcap, r_1.mcap, r_2.mcap', ''))
    with pytest.raises(BagError, match=f'r_1.mcap: {words}.*bag recover') as error:
        Bag(path.parent)
    assert error.value.path == path
    assert any('r_1.mcap' in finding.what for finding in diagnose(path.parent).findings)
    recovered = recover(path.parent, tmp_path / 'out')
    assert any('r_1.mcap' in line for line in recovered.lines())
    assert recovered.lost or kind == 'empty'
    assert sum(recovered.counts.values()) == 2 * len(SENT) // 3
    if kind != 'folder':  # alone
        with pytest.raises(BagError, match=words.split('.*')[0]):
            Bag(path)


def test_a_file_without_permission_is_named(tmp_path):
    with tempfile.TemporaryDirectory() as place:  # not below a folder of root's
        os.chmod(place, 0o755)
        folder = splits(Path(place, 'bag'))
        os.chmod(folder / 'r_1.mcap', 0)
        own = os.geteuid()
        try:
            if own == 0:
                os.seteuid(65534)
            with pytest.raises(BagError, match='r_1.mcap: cannot be read .*permissions.*recover'):
                Bag(folder)
            assert any('r_1.mcap' in f.what for f in diagnose(folder).findings)
        finally:
            os.seteuid(own)


def test_a_split_that_is_missing_by_the_numbers_is_named(tmp_path):
    folder = splits(tmp_path / 'r')
    (folder / 'r_1.mcap').rename(tmp_path / 'r_1.mcap')
    with pytest.raises(BagError, match='r_1.mcap: is not there, by the numbers') as error:
        Bag(folder)
    assert f'vn_nav bag recover {folder} NEW' in error.value.remedy
    assert any('r_1.mcap' in finding.what for finding in diagnose(folder).findings)
    recovered = recover(folder, tmp_path / 'out')
    assert recovered.lost and any('r_1.mcap' in line for line in recovered.lines())
    (tmp_path / 'r_1.mcap').rename(folder / 'r_1.mcap')
    Bag(folder)
    (folder / 'r_0.mcap').unlink()
    with pytest.raises(BagError, match='r_0.mcap: is not there'):
        Bag(folder)
    folder.rename(tmp_path / 'mine')  # then r_1 may be its owner's first
    assert len(list(messages(tmp_path / 'mine'))) == 2 * len(SENT) // 3
    for names in ('a_2024_01_02 a_2024_01_05', 'a_1700000000 a_1700000600', 'a_7 b_9', 'a1 a3'):
        other = splits(tmp_path / names)
        for k, name in enumerate(names.split()):  # dates are no numbers of splits
            (other / f'r_{k}.mcap').rename(other / f'{name}.mcap')
        (other / 'r_2.mcap').unlink()
        assert len(list(messages(other))) == 2 * len(SENT) // 3


@pytest.mark.slow
def test_what_sqlite_has_not_yet_put_into_its_file_is_converted_too(tmp_path):
    folder = recorded(tmp_path / 'my bag', StoragePlugin.SQLITE3)
    path = next(folder.glob('*.db3'))
    kept = {}
    with contextlib.closing(sqlite3.connect(path)) as base:
        base.execute('PRAGMA journal_mode=WAL')
        base.execute('INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, '
                     'timestamp + 5, data FROM messages WHERE topic_id = 1')
        base.commit()
        kept = {file.name: file.read_bytes() for file in folder.iterdir()}
    for name, data in kept.items():
        (folder / name).write_bytes(data)  # as a killed recorder leaves it
    assert kept[f'{path.name}-wal']
    with contextlib.closing(sqlite3.connect(f'file:{path}?immutable=1', uri=True)) as base:
        (before,) = base.execute('SELECT count(*) FROM messages').fetchone()
    assert before == len(SENT)  # as the converter reads it
    command = re.search('`(.*)`', refusal(folder, 'a bag is a folder').remedy).group(1)
    assert 'wal_checkpoint' in refusal(path, 'a bag in SQLite').remedy
    (folder / 'metadata.yaml').rename(tmp_path / 'metadata.yaml')
    assert 'wal_checkpoint' in refusal(folder, 'a bag in SQLite').remedy
    (tmp_path / 'metadata.yaml').rename(folder / 'metadata.yaml')
    if shutil.which('sqlite3') is None:
        pytest.skip('expected: sqlite3 is not installed')
    program = Path(sys.executable).with_name('rosbags-convert')
    subprocess.run(['sh', '-c', command.replace('rosbags-convert', str(program), 1)],
                   check=True, capture_output=True)
    assert len(list(messages(tmp_path / 'my bag_mcap'))) > len(SENT)


def test_other_things_in_the_folder_do_no_harm(tmp_path):
    folder = splits(tmp_path / 'bag')
    for name in ('notes.txt', 'map.png', 'x.mcap.md5', 'archive.zst', 'README', 'map.db',
                 'metadata.yaml.bak', 'metadata.yaml~', '.r_3.mcap.Xy12', '._r_0.mcap',
                 'x.bag.yaml'):
        (folder / name).write_bytes(b'')
    (folder / 'old').mkdir()
    write(folder / 'old' / 'x.mcap', [('/a', STRING, 10**18, make(STRING))])
    assert len(list(messages(folder))) == len(SENT)
