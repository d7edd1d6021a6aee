"""A peer of the `ai2thor` client that stands in for Unity: it draws embedded houses.

    python thor_peer.py

It is run by the client as the executable, speaks its FIFO protocol and keeps to Unity's frame and
words: left-handed, y up, degrees. `FloorPlanN` is the house of seed N with two rooms, a ProcTHOR
house is the one of its seed. What Unity looks like, weighs or gets stuck on, it says nothing of.
"""

import json
import math
import os
import struct
import sys

import msgpack
import numpy as np

from vn_nav.robot import RobotSpec
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.houses.objects import GOAL_OBJECTS, object_scene
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.simulator import Placed
from vn_sim_bridge.simulators.house import HouseSimulator

METADATA, ACTION, RGB, DEPTH, IDS, END = 1, 2, 4, 5, 9, 255
CENTRE = 0.9  # m, height of the agent's centre above the floor, as Unity reports it
EYE = 1.5  # m, of its camera
SEEN = 1.5  # m, farther away nothing counts as visible
NAMES = [''.join(part.title() for part in label.split('_')) for label in LABELS]


class Refused(Exception):
    """An action that fails: its message, and the code of one that is not understood."""

    def __init__(self, message, code=''):
        super().__init__(message)
        self.code = code


class House:
    """A loaded scene with the agent in it, in Unity's frame."""

    def __init__(self, seed, size, fov, arm):
        robot = RobotSpec(camera_height=EYE, camera_fov=math.radians(fov))
        self.house = generate_house(seed, rooms=2)
        self.arm, self.seed = arm, seed
        self.simulator = HouseSimulator([self.house], [0], robot=robot, size=size,
                                        models=GOAL_OBJECTS, objects=len(GOAL_OBJECTS))
        self.rotation, self.horizon = 0.0, 0.0
        self.x, self.z = self.to_unity(*self.house.floor.centres()[0])
        self.scatter(seed)
        self.ids = [f'{NAMES[LABELS.index(name)]}|{item.y:+.2f}|+0.00|{item.x:+.2f}'
                    for name, item in zip(GOAL_OBJECTS, self.objects, strict=True)]
        self.colours = self.make_colours()

    @staticmethod
    def to_unity(x, y):
        """The house's ground plane, seen from above, on Unity's: turned by a quarter."""
        return -y, x

    def make_colours(self):
        """Colour by instance and class; rows (code, name, colour)."""
        scene = self.house.scene
        codes = {(int(i), int(k)) for i, k in zip(scene.face_instance, scene.face_label,
                                                  strict=True)}
        rows = [(i << 8 | k, NAMES[k] if k < 4 else f'{NAMES[k]}|{i}') for i, k in sorted(codes)]
        for m, name in enumerate(GOAL_OBJECTS):
            for k in np.unique(object_scene(name).face_label):
                rows.append(((65535 - m) << 8 | int(k), self.ids[m]))
        return [(code, name, [1 + n % 251, n // 251, 77]) for n, (code, name) in enumerate(rows)]

    def scatter(self, seed):
        rng, cells = np.random.default_rng(seed), self.house.floor.centres()
        self.objects = [Placed(m, *map(float, cells[rng.integers(len(cells))]),
                               float(rng.uniform(0, 2 * math.pi)))
                        for m in range(len(GOAL_OBJECTS))]

    def drive(self, ahead, right):
        """Along the agent's axes; whether the way was free, and it is moved as far as it was."""
        simulator = self.simulator
        simulator.poses[0] = self.z, -self.x, -math.radians(self.rotation), 0.0
        motion = simulator.move(np.array([[ahead, -right, 0.0, 0.0]]))
        self.z, self.x = float(simulator.poses[0, 0]), -float(simulator.poses[0, 1])
        return not motion.collided[0]

    def draw(self):
        simulator = self.simulator
        simulator.poses[0] = (self.z, -self.x, -math.radians(self.rotation),
                              math.radians(self.horizon))
        simulator.set_objects(0, self.objects)
        frames = simulator.observe()
        code = frames.instances[0].astype(np.int64) << 8 | frames.labels[0]
        known = np.array([row[0] for row in self.colours])
        order = np.argsort(known)
        at = order[np.clip(np.searchsorted(known[order], code), 0, len(known) - 1)]
        table = np.array([[*row[2], 255] for row in self.colours], np.uint8)
        ids = np.where((known[at] == code)[..., None], table[at],
                       np.array([0, 0, 0, 255], np.uint8))
        return frames.rgb[0].transpose(1, 2, 0), frames.depth[0], ids, frames.instances[0]

    def agent(self):
        return {'position': {'x': self.x, 'y': CENTRE, 'z': self.z},
                'rotation': {'x': 0.0, 'y': self.rotation % 360.0, 'z': 0.0},
                'cameraHorizon': self.horizon, 'isStanding': True}

    def things(self, instances):
        """Metadata of the movable objects, and of the furniture."""
        rows = []
        for m, item in enumerate(self.objects):
            x, z = self.to_unity(item.x, item.y)
            far = math.hypot(x - self.x, z - self.z)
            rows.append({'objectId': self.ids[m], 'name': f'thing_{m}', 'pickupable': True,
                         'objectType': self.ids[m].split('|')[0], 'moveable': False,
                         'visible': bool(far < SEEN and (instances == 65535 - m).any()),
                         'distance': far, 'position': {'x': x, 'y': 0.1, 'z': z},
                         'rotation': {'x': 0.0, 'y': -math.degrees(item.yaw), 'z': 0.0}})
        for k, piece in enumerate(self.house.obstacles):
            if piece.label in LABELS[4:]:
                x, z = self.to_unity((piece.rect.x0 + piece.rect.x1) / 2,
                                     (piece.rect.y0 + piece.rect.y1) / 2)
                kind = NAMES[LABELS.index(piece.label)]
                rows.append({'objectId': f'{kind}|{x:+.2f}|+0.40|{z:+.2f}', 'name': f'piece_{k}',
                             'objectType': kind, 'pickupable': False, 'moveable': False,
                             'visible': False, 'distance': math.hypot(x - self.x, z - self.z),
                             'position': {'x': x, 'y': 0.4, 'z': z},
                             'rotation': {'x': 0.0, 'y': 0.0, 'z': 0.0}})
        return rows


class Peer:
    """The engine: answers actions until its pipe is closed."""

    def __init__(self):
        self.out = open(os.environ['AI2THOR_FIFO_SERVER_PIPE_PATH'], 'wb')
        self.width = self.height = 300
        self.scene, self.house, self.options, self.loaded = 'Procedural', None, {}, None
        self.answer({'sequenceId': 0, 'action': ''}, None, '', '')
        self.into = open(os.environ['AI2THOR_FIFO_CLIENT_PIPE_PATH'], 'rb')

    def field(self, kind, body):
        self.out.write(struct.pack('!BI', kind, len(body)) + body)

    def answer(self, action, result, code, message):
        failed = bool(code or message)
        meta = {'screenWidth': self.width, 'screenHeight': self.height, 'thirdPartyCameras': [],
                'sceneName': self.scene, 'lastAction': action['action'], 'errorCode': code,
                'lastActionSuccess': not failed, 'errorMessage': message, 'actionReturn': result,
                'objects': [], 'colors': [], 'depthFormat': 'Meters',
                'agent': {'position': {'x': 0.0, 'y': CENTRE, 'z': 0.0},
                          'rotation': {'x': 0.0, 'y': 0.0, 'z': 0.0}, 'cameraHorizon': 0.0}}
        pictures = []
        if self.house is not None:
            rgb, depth, ids, instances = self.house.draw()
            meta |= {'agent': self.house.agent(), 'objects': self.house.things(instances),
                     'cameraPosition': {'x': self.house.x, 'y': EYE, 'z': self.house.z},
                     'colors': [{'name': name, 'color': colour}
                                for _, name, colour in self.house.colours]}
            pictures = [(RGB, rgb)]
            if self.options.get('renderDepthImage'):
                pictures.append((DEPTH, depth))
            if self.options.get('renderInstanceSegmentation'):
                pictures.append((IDS, ids))
        self.field(METADATA, msgpack.dumps({'agents': [meta], 'thirdPartyCameras': [],
                                            'activeAgentId': 0,
                                            'sequenceId': action['sequenceId']}))
        for kind, picture in pictures:  # the bottom row comes first
            self.field(kind, np.ascontiguousarray(picture[::-1]).tobytes())
        self.field(END, b'')
        self.out.flush()

    def read(self):
        """The next action; None: nobody asks any more."""
        action = None
        while len(header := self.into.read(5)) == 5:
            kind, length = struct.unpack('!BI', header)
            if kind == END:
                return action
            action = json.loads(self.into.read(length))
        return None

    def run(self):
        while (action := self.read()) is not None:
            result, code, message = None, '', ''
            try:
                given = {key: value for key, value in action.items()
                         if key not in ('action', 'sequenceId')}
                do = getattr(self, f'do_{action["action"]}', None)
                if do is None:
                    raise Refused(f'{action["action"]} is not an action', 'InvalidAction')
                result = do(**given)
            except Refused as refused:
                code, message = refused.code, str(refused)
            except TypeError as error:
                code, message = 'InvalidArgument', str(error)
            self.answer(action, result, code, message)

    def do_ChangeResolution(self, x, y):
        self.width, self.height = x, y

    def do_GetScenesInBuild(self):
        return [f'FloorPlan{kind + k}_physics' for kind in (0, 200, 300, 400)
                for k in range(1, 31)] + ['FloorPlan_Train1_1', 'Procedural']

    def do_Reset(self, sceneName):
        self.scene, self.house = sceneName, None

    def do_Initialize(self, **options):
        self.options = options
        if self.scene != 'Procedural':
            self.load(int(''.join(c for c in self.scene if c.isdigit())))
        return {'cameraNearPlane': 0.1, 'cameraFarPlane': 20.0}

    def load(self, seed):
        key = (seed, self.width)
        self.house = House(seed, self.width, self.options.get('fieldOfView', 90.0),
                           self.options.get('agentMode') == 'arm')
        self.loaded = key

    def do_CreateHouse(self, house):
        self.load(int(house['seed']))

    def do_TeleportFull(self, x, y, z, rotation, horizon, standing, forceAction=False):
        if not -30.001 <= horizon <= 60.001:
            raise Refused(f'horizon {horizon} is outside of [-30, 60]')
        house = self.house
        house.x, house.z, house.rotation, house.horizon = x, z, rotation['y'], horizon

    def move(self, ahead, right, returnToStart=True):
        house = self.house
        before = house.x, house.z
        if not house.drive(ahead, right):
            if returnToStart or not house.arm:
                house.x, house.z = before
            raise Refused('a wall is blocking the agent')

    def do_MoveAhead(self, moveMagnitude, **options):
        self.move(moveMagnitude, 0.0, **options)

    def do_MoveBack(self, moveMagnitude, **options):
        self.move(-moveMagnitude, 0.0, **options)

    def do_MoveRight(self, moveMagnitude, **options):
        self.move(0.0, moveMagnitude, **options)

    def do_MoveLeft(self, moveMagnitude, **options):
        self.move(0.0, -moveMagnitude, **options)

    def do_RotateRight(self, degrees, **options):
        self.house.rotation = (self.house.rotation + degrees) % 360.0

    def do_RotateLeft(self, degrees, **options):
        self.house.rotation = (self.house.rotation - degrees) % 360.0

    def tilt(self, degrees):
        if not -30.001 <= self.house.horizon + degrees <= 60.001:
            raise Refused('it cannot look that far')
        self.house.horizon += degrees

    def do_LookDown(self, degrees):
        self.tilt(degrees)

    def do_LookUp(self, degrees):
        self.tilt(-degrees)

    def do_GetReachablePositions(self):
        return [dict(zip('xz', self.house.to_unity(*cell), strict=True), y=CENTRE)
                for cell in self.house.house.floor.centres().tolist()]

    def do_InitialRandomSpawn(self, randomSeed, forceVisible=False, numPlacementAttempts=5,
                              placeStationary=True):
        self.house.scatter(randomSeed)

    def do_SetObjectPoses(self, objectPoses, placeStationary=True):
        by_name = {row['objectName']: row for row in objectPoses}
        house = self.house
        house.objects = [
            Placed(item.model, row['position']['z'], -row['position']['x'],
                   -math.radians(row['rotation']['y']))
            if (row := by_name.get(f'thing_{m}')) else item
            for m, item in enumerate(house.objects)]


if __name__ == '__main__':
    try:
        Peer().run()
    except (BrokenPipeError, KeyboardInterrupt):
        sys.exit(0)
