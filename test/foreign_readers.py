"""Bags before the readers that others use."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader


def information(folder):
    """What the metadata of a bag says."""
    return yaml.safe_load((folder / 'metadata.yaml').read_text())['rosbag2_bagfile_information']


def assert_every_reader_accepts(folder):
    """`rosbags`, `mcap` with all checksums, and `pymcap-cli doctor`."""
    told = information(folder)
    with AnyReader([folder]) as reader:
        assert reader.message_count == told['message_count']
        assert sum(1 for _ in reader.messages()) == told['message_count']
        assert all(connection.msgcount for connection in reader.connections)
    counted = 0
    doctor = shutil.which('pymcap-cli',
                          path=f'{Path(sys.executable).parent}:{os.environ["PATH"]}')
    assert doctor, 'pymcap-cli is not installed: pip install pymcap-cli'
    for name in told['relative_file_paths']:
        with open(folder / name, 'rb') as file:
            counted += sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
        done = subprocess.run([doctor, 'doctor', '--strict-message-order', folder / name],
                              capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stdout[-2000:]
    assert counted == told['message_count']
