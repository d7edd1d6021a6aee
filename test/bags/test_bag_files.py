"""A bag's folder is read whole or refused, with a command that really converts it."""

import gzip
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import zstandard
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from small_bags import STORE, STRING, drive, make, serialised, write

from vn_nav import cli
from vn_nav.bags.dataset import Wanted, load_drives
from vn_nav.bags.doctor.checks import diagnose
from vn_nav.bags.doctor.recover import recover
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


def test_other_things_in_the_folder_do_no_harm(tmp_path):
    folder = splits(tmp_path / 'bag')
    for name in ('notes.txt', 'map.png', 'x.mcap.md5', 'archive.zst'):
        (folder / name).write_bytes(b'')
    (folder / 'old').mkdir()
    write(folder / 'old' / 'x.mcap', [('/a', STRING, 10**18, make(STRING))])
    assert len(list(messages(folder))) == len(SENT)
