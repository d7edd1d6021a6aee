"""Columns, names and paths of LeRobot's format version 3.0."""

from __future__ import annotations

import json

import numpy as np

VERSION = 'v3.0'
CAMERA, STATE, ACTION = 'observation.images.camera', 'observation.state', 'action'
STATES = ('x', 'y', 'yaw', 'vx', 'vy', 'wz')  # m, rad; m/s, rad/s in the robot's frame
ACTIONS = ('vx', 'vy', 'wz')  # m/s, rad/s
TO_GOAL, DRIVE = 'drive to where the goal picture was taken', 'drive'
FILE = 'chunk-{chunk_index:03d}/file-{file_index:03d}'
FIRST = FILE.format(chunk_index=0, file_index=0)
NUMBERS = {'timestamp': 'float32', 'frame_index': 'int64', 'episode_index': 'int64',
           'index': 'int64', 'task_index': 'int64'}

CARD = """---
tags:
- LeRobot
configs:
- config_name: default
  data_files: data/*/*.parquet
---

A drive of a mobile robot, exported from the ROS 2 bag `{bag}` by vn_nav {version} at {fps} Hz,
in LeRobot's format 3.0.

- `observation.images.camera`: the picture nearest to the instant.
- `observation.state`: x, y [m], yaw [rad] by {posed}; vx, vy [m/s], wz [rad/s] in the
  robot's frame (x forward, y left).
- `action`: mean vx, vy [m/s], wz [rad/s] from this instant until the next, as {acted}.
"""


def tasks_table(tasks: list[str]):
    """Tasks as pandas reads them: the text is the index, as the metadata states."""
    import pyarrow
    columns = [{'name': name, 'field_name': name, 'pandas_type': kind, 'numpy_type': numpy,
                'metadata': None} for name, kind, numpy in (
                    ('task_index', 'int64', 'int64'), ('task', 'unicode', 'object'))]
    pandas = {'index_columns': ['task'], 'column_indexes': [], 'columns': columns,
              'creator': {'library': 'pyarrow', 'version': pyarrow.__version__},
              'pandas_version': None}
    table = pyarrow.table({'task_index': np.arange(len(tasks)), 'task': tasks})
    return table.replace_schema_metadata({'pandas': json.dumps(pandas)})
