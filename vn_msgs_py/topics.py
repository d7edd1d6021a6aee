"""The topic contract: one table for nodes, bags and documentation. Names are relative."""

from __future__ import annotations

import dataclasses

RELIABLE, BEST_EFFORT = 'reliable', 'best_effort'
VOLATILE, LATCHED = 'volatile', 'transient_local'


@dataclasses.dataclass(frozen=True)
class Topic:
    """One topic. Quality of service follows REP 2003: sensors best effort, facts latched.

    It is what a listener asks for. The bridge publishes everything reliably: that serves both
    kinds of listener.
    """

    name: str
    type: str
    publisher: str  # robot (or the bridge in its place), bridge, policy, route, user
    meaning: str
    reliability: str = RELIABLE
    durability: str = VOLATILE
    depth: int = 10
    debug: bool = False  # to be looked at: recorded only where it is named


def _sensor(name, kind, publisher, meaning):
    return Topic(name, kind, publisher, meaning, BEST_EFFORT, VOLATILE, 1)


def _latched(name, kind, publisher, meaning):
    return Topic(name, kind, publisher, meaning, RELIABLE, LATCHED, 1)


def _history(name, kind, publisher, meaning):
    # Discovery can take seconds: a recorder that is matched late gets what it missed. For what is
    # rare and must not be missed: in a stream a newcomer would have to wade through the past.
    return Topic(name, kind, publisher, meaning, RELIABLE, LATCHED, 2000)


_IMAGE, _STRING = 'sensor_msgs/msg/Image', 'std_msgs/msg/String'

TOPICS = (
    _sensor('image_raw', _IMAGE, 'robot', 'camera picture, any encoding of vn_msgs_py.images'),
    _sensor('image_raw/compressed', 'sensor_msgs/msg/CompressedImage', 'robot',
            'camera picture as JPEG or PNG (image_transport: compressed)'),
    _sensor('camera_info', 'sensor_msgs/msg/CameraInfo', 'robot',
            'lens of the camera, by which pictures are rectified and cut'),
    _latched('goal_image', _IMAGE, 'user',
             'where to go; a new header stamp begins a new episode'),
    _latched('goal_camera_info', 'sensor_msgs/msg/CameraInfo', 'user',
             "camera of the goal_image of the same stamp, where it is not the robot's"),
    Topic('cmd_vel', 'geometry_msgs/msg/Twist', 'policy',
          'velocity command; TwistStamped with enable_stamped_cmd_vel', depth=1),
    Topic('shadow/cmd_vel', 'geometry_msgs/msg/Twist', 'policy',
          'mode shadow, in place of cmd_vel: no base subscribes to it', depth=1),
    Topic('executed_action', _STRING, 'user',
          'mode shadow: JSON: the stamp of a picture where a decision is wanted, the action '
          'really done before it, and odometry [x, y, yaw] there, if known; ranges: the stamp '
          'and the odometry of the scan or depth picture that belongs to it, or null'),
    Topic('odom', 'nav_msgs/msg/Odometry', 'robot', 'wheel odometry; actions are closed on it'),
    _history('action', 'std_msgs/msg/Int8', 'policy', 'discrete action chosen, for recording'),
    _latched('action_names', _STRING, 'policy', 'JSON list: the names behind action'),
    _latched('arrived', 'std_msgs/msg/Bool', 'policy',
             'true: it declares arrival and stands still; false: it does not, published '
             'again for every goal'),
    _latched('goal_status', _STRING, 'policy',
             'JSON: number of the goal, stamp of its picture; waiting, active, succeeded, failed '
             'or cancelled; error code and message (docs/nav2.md), decisions, seconds'),
    Topic('route_goal', _STRING, 'user', 'where route_node drives: the name of a place, or the '
          'number of a picture; empty: stop', depth=1),
    _latched('route_status', _STRING, 'route',
             'JSON: place, status (locating, active, succeeded, failed, cancelled), error '
             'message, the pictures shown and nearest, names of places'),
    dataclasses.replace(Topic(
        'goal_feedback', _STRING, 'policy', 'JSON, at every decision: the same, the state, '
        'probability of arrival, estimated distance [m]'), debug=True),
    dataclasses.replace(Topic(
        'goal_estimate', 'geometry_msgs/msg/PoseStamped', 'policy', 'where a policy that '
        'searches takes the goal to be, at every decision that has a guess', depth=1),
        debug=True),
    dataclasses.replace(_latched(
        'policy_node/map', 'nav_msgs/msg/OccupancyGrid', 'policy',
        'debug: the map of a policy that searches, 0 free to 100 occupied, -1 unknown; once a '
        'second at most, when somebody listens'), debug=True),
    dataclasses.replace(_latched(
        'policy_node/hypotheses', 'geometry_msgs/msg/PoseArray', 'policy',
        'debug: where it takes the goal to be, the likeliest first; as the map'), debug=True),
    Topic('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', 'policy, bridge',
          'state and reasons'),
    _sensor('depth/image_raw', _IMAGE, 'bridge', '32FC1 metres, exact'),
    _sensor('depth/camera_info', 'sensor_msgs/msg/CameraInfo', 'bridge',
            'the same camera, for the depth picture'),
    _sensor('labels/image_raw', _IMAGE, 'bridge',
            'class ids: mono8; 16UC1 of more than 256 classes'),
    _latched('labels/names', _STRING, 'bridge', 'JSON list: the names behind the class ids'),
    _history('collision', 'std_msgs/msg/Bool', 'bridge',
             "at a decision's end: it touched something"),
    _history('reward', 'std_msgs/msg/Float32', 'bridge',
             "at a decision's end: 1 on arrival, else 0"),
    _history('episode_end', 'std_msgs/msg/UInt8', 'bridge', '1 terminated, 2 truncated'),
    # Five seconds of history: a recorder that is matched late has the beginning, too.
    Topic('ground_truth/odom', 'nav_msgs/msg/Odometry', 'bridge',
          'true pose in the map, for evaluation; the policy never reads it', RELIABLE, LATCHED,
          100),
    _sensor('scan', 'sensor_msgs/msg/LaserScan', 'bridge',
            'exact, all around, at what the robot would bump into'),
    Topic('/tf', 'tf2_msgs/msg/TFMessage', 'bridge',
          'odom to base_link to the camera; needs an installed tf2_msgs', depth=100),
    _latched('/tf_static', 'tf2_msgs/msg/TFMessage', 'bridge',
             'base_link to the scanner, the camera to its optical frame'),
    _latched('scene', _STRING, 'bridge', 'JSON: house, rooms, goals, limits, world version'),
    _history('episode', _STRING, 'bridge', 'JSON: goal and start of every episode'),
    _history('episode_result', _STRING, 'bridge', 'JSON: outcome of the episode that ended'),
    Topic('goal_pose', 'geometry_msgs/msg/PoseStamped', 'user',
          "a goal by pose, in map or odom; taken by the bridge's ~/reset", depth=1),
    _sensor('/clock', 'rosgraph_msgs/msg/Clock', 'bridge',
            'simulated time; of a bridge in a namespace: `clock` in there'),
)


def topic(name: str) -> Topic:
    """The topic of a name.

    Raises:
        KeyError: a name that is not in the contract.
    """
    for entry in TOPICS:
        if entry.name == name:
            return entry
    raise KeyError(f'the topic is one of the contract; received {name!r}; see vn_msgs_py.topics')


def markdown_table() -> str:
    """The contract as the table of the README."""
    rows = ['| topic | type | QoS | from | meaning |', '|---|---|---|---|---|']
    for t in TOPICS:
        qos = f'{t.reliability.replace("_", " ")}' + (', latched' if t.durability == LATCHED
                                                      else '') + f', {t.depth}'
        rows.append(f'| `{t.name}` | `{t.type.replace("/msg/", "/")}` | {qos} | {t.publisher} | '
                    f'{t.meaning} |')
    return '\n'.join(rows)
