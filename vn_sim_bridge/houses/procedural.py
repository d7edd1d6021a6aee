"""Seeded procedural houses: the same seed and room count give the same house."""

from __future__ import annotations

import math

import numpy as np

from vn_nav.errors import UserError
from vn_sim_bridge.houses.furniture import (
    FABRICS,
    KINDS,
    LABEL,
    ROOM_PROGRAMMES,
    WHITES,
    WOODS,
    Piece,
)
from vn_sim_bridge.houses.house import (
    FREE_MARGIN,
    Goal,
    House,
    Obstacle,
    Room,
    clearance,
    floor_map,
    grid_of,
    main_component,
)
from vn_sim_bridge.houses.layout import WALL, Door, Rect, place_doors, split, wall_obstacles
from vn_sim_bridge.houses.textures import PAINTINGS, TEXTURES
from vn_sim_bridge.houses.viewpoints import choose_goals
from vn_sim_bridge.scene import SceneBuilder

HEIGHT = 2.6  # m, of rooms
DOOR_HEIGHT = 2.05  # m
ROOM_AREA = 15.0  # m^2, mean area of a room between wall centres
MAX_ROOMS = 8
DOOR_SPACE = 0.75  # m in front of a door that furniture leaves free
FOOTPRINT_RADIUS = 0.18  # m, the standard robot

# Room types in the order in which a house gets them.
ROOM_ORDER = ('living_room', 'kitchen', 'bedroom', 'bathroom', 'office', 'dining_room', 'bedroom',
              'hall')
WALL_TEXTURES = ('plaster', 'plain', 'stripes', 'dots', 'brick', 'plaster')
FLOOR_TEXTURES = ('planks', 'tiles', 'checker', 'marble', 'fabric')
WALL_COLOURS = ((0.93, 0.90, 0.82), (0.80, 0.86, 0.90), (0.86, 0.90, 0.78), (0.94, 0.82, 0.76),
                (0.85, 0.80, 0.90), (0.96, 0.92, 0.66), (0.72, 0.82, 0.80), (0.90, 0.70, 0.62))


def generate_house(seed: int, *, rooms: int = 5) -> House:
    """Build a house.

    Args:
        seed: any integer from 0 on; equal seeds give equal houses.
        rooms: number of rooms, 1 to 8.

    Raises:
        UserError: a seed or a number of rooms outside its range.
    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise UserError('the seed of a house is a whole number from 0 on', seed, 'choose another')
    if not 1 <= rooms <= MAX_ROOMS:
        raise UserError(f'a house has 1 to {MAX_ROOMS} rooms', rooms, 'choose a number in range')
    rng = np.random.default_rng([seed, rooms])
    while True:  # a floor plan without doors for every room is drawn again; seldom more than twice
        area = rooms * ROOM_AREA * rng.uniform(0.95, 1.15)
        aspect = rng.uniform(0.75, 1.35)
        outline = Rect(0.0, 0.0, math.sqrt(area * aspect), math.sqrt(area / aspect))
        cells = split(outline, rooms, rng)
        doors = place_doors(cells, rng)
        if doors is not None:
            break
    return _Construction(seed, outline, cells, doors, rng).house()


class _Construction:
    """The state while one house is built: surfaces, then furniture, then goals."""

    def __init__(self, seed, outline: Rect, cells: list[Rect], doors: list[Door],
                 rng: np.random.Generator):
        self.seed, self.outline, self.cells, self.doors, self.rng = (
            seed, outline, cells, doors, rng)
        self.builder = SceneBuilder()
        self.instance = 0
        self.obstacles = [Obstacle(rect, 'wall') for rect in wall_obstacles(outline, cells, doors)]
        self.rooms = self._name_rooms()
        self.origin, self.shape = grid_of(outline)
        self.clearance = clearance(self.origin, self.shape,
                                   np.array([o.rect for o in self.obstacles]))

    def house(self) -> House:
        """Run the construction."""
        for index in range(len(self.rooms)):
            self._surfaces(index)
        for door in self.doors:
            self._doorway(door)
        for index in range(len(self.rooms)):
            self._furnish(index)
        for index in range(len(self.rooms)):
            self._decorate(index)
        scene = self.builder.build()
        floor = floor_map(self.outline, np.array([o.rect for o in self.obstacles]),
                          FOOTPRINT_RADIUS)
        goals = choose_goals(scene, self.rooms, floor, self.rng)
        return House(f'house-{self.seed}-{len(self.rooms)}', self.seed, self.outline, scene,
                     tuple(self.rooms), tuple(self.obstacles),
                     tuple(Goal(pose, room) for pose, room in goals), FOOTPRINT_RADIUS)

    def _name_rooms(self) -> list[Room]:
        kinds = list(ROOM_ORDER[:len(self.cells)])
        self.rng.shuffle(kinds)
        # The smallest cell becomes the bathroom, the largest the living room.
        order = np.argsort([cell.area for cell in self.cells])
        for kind, place in (('bathroom', order[0]), ('living_room', order[-1])):
            if kind in kinds and len(kinds) > 1:
                other = kinds.index(kind)
                kinds[other], kinds[place] = kinds[place], kinds[other]
        half = WALL / 2
        rooms, seen = [], {}
        for kind, cell in zip(kinds, self.cells, strict=True):
            seen[kind] = seen.get(kind, 0) + 1
            name = kind.replace('_', ' ') + (f' {seen[kind]}' if seen[kind] > 1 else '')
            rooms.append(Room(name, kind, Rect(cell.x0 + half, cell.y0 + half,
                                               cell.x1 - half, cell.y1 - half)))
        return rooms

    def _next_instance(self) -> int:
        self.instance += 1
        return self.instance

    def _colour(self, palette, spread=0.08):
        colour = np.array(palette[int(self.rng.integers(len(palette)))])
        return np.clip(colour * (1 + self.rng.uniform(-spread, spread, 3)), 0.05, 1.0)

    def _add(self, points, label, texture, colour, instance, **options):
        self.builder.polygon(points, texture=TEXTURES[texture], colour=colour, label=LABEL[label],
                             instance=instance, **options)

    def _openings(self, index: int) -> dict[str, list[tuple[float, float]]]:
        """Door openings of a room by wall: 'south', 'north', 'west', 'east'."""
        found = {'south': [], 'north': [], 'west': [], 'east': []}
        for door in self.doors:
            if index == door.first:
                found['north' if door.axis == 0 else 'east'].append((door.low, door.high))
            if index == door.second:
                found['south' if door.axis == 0 else 'west'].append((door.low, door.high))
        return {wall: sorted(spans) for wall, spans in found.items()}

    def _surfaces(self, index: int) -> None:
        """Floor, ceiling and the four walls of a room, cut out at doors."""
        room = self.rooms[index]
        x0, y0, x1, y1 = room.rect
        wet = room.kind in ('kitchen', 'bathroom')
        floor_texture = self.rng.choice(('tiles', 'checker', 'marble') if wet else FLOOR_TEXTURES)
        floor_colour = self._colour(WHITES + WALL_COLOURS if wet else WOODS + FABRICS[3:4])
        wall_texture = str(self.rng.choice(WALL_TEXTURES))
        wall_colour = self._colour(WALL_COLOURS)
        instance = self._next_instance()
        self._add([(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)], 'floor',
                  str(floor_texture), floor_colour, instance, tile=1.6)
        self._add([(x0, y1, HEIGHT), (x1, y1, HEIGHT), (x1, y0, HEIGHT), (x0, y0, HEIGHT)],
                  'ceiling', 'plaster', self._colour(WHITES, 0.02), self._next_instance(),
                  tile=1.5)
        self.builder.end_group()
        openings = self._openings(index)
        # Each wall from its left to its right end, seen from inside the room.
        ends = {'south': ((x1, y0), (x0, y0)), 'north': ((x0, y1), (x1, y1)),
                'west': ((x0, y0), (x0, y1)), 'east': ((x1, y1), (x1, y0))}
        for wall, (start, end) in ends.items():
            instance = self._next_instance()
            start, end = np.array(start), np.array(end)
            axis = 0 if wall in ('south', 'north') else 1
            backwards = end[axis] < start[axis]
            cuts = [start[axis]]
            for low, high in openings[wall][::-1] if backwards else openings[wall]:
                cuts += [high, low] if backwards else [low, high]
            cuts.append(end[axis])
            for k in range(len(cuts) - 1):
                bottom = DOOR_HEIGHT if k % 2 else 0.0  # above a door, or from the floor
                a, b = start.copy(), start.copy()
                a[axis], b[axis] = cuts[k], cuts[k + 1]
                self._add([(*a, bottom), (*b, bottom), (*b, HEIGHT), (*a, HEIGHT)], 'wall',
                          wall_texture, wall_colour, instance, tile=1.2)
            self.builder.end_group()

    def _doorway(self, door: Door) -> None:
        """Threshold, jambs and lintel of an opening."""
        half = WALL / 2
        wood = self._colour(WOODS + WHITES)
        instance = self._next_instance()

        def place(along, across, z):
            return (along, door.at + across, z) if door.axis == 0 else (door.at + across, along, z)

        quads = {
            'floor': [(door.low, -half, 0), (door.high, -half, 0), (door.high, half, 0),
                      (door.low, half, 0)],
            'lintel': [(door.low, half, DOOR_HEIGHT), (door.high, half, DOOR_HEIGHT),
                       (door.high, -half, DOOR_HEIGHT), (door.low, -half, DOOR_HEIGHT)],
            'low': [(door.low, half, 0), (door.low, -half, 0), (door.low, -half, DOOR_HEIGHT),
                    (door.low, half, DOOR_HEIGHT)],
            'high': [(door.high, -half, 0), (door.high, half, 0), (door.high, half, DOOR_HEIGHT),
                     (door.high, -half, DOOR_HEIGHT)],
        }
        for name, quad in quads.items():
            points = [place(*point) for point in quad]
            if name in ('low', 'high'):
                points = points[::-1]
            if door.axis == 1:
                points = points[::-1]  # swapping the axes mirrors the winding
            self._add(points, 'door', 'wood', wood, instance)
        self.builder.end_group()

    def _furnish(self, index: int) -> None:
        room = self.rooms[index]
        for name in ROOM_PROGRAMMES[room.kind]:
            for _ in range(12):
                if self._try_piece(index, name):
                    break

    def _try_piece(self, index: int, name: str) -> bool:
        """Put a piece at a random place along a random wall; False when it does not fit."""
        room, kind = self.rooms[index], KINDS[name]
        width, depth, height = (self.rng.uniform(*span)
                                for span in (kind.width, kind.depth, kind.height))
        quarter = int(self.rng.integers(4))
        gap = 0.01
        # Quarter 0 stands at the south wall and faces north; each further one turns left.
        x0, y0, x1, y1 = room.rect
        length = (x1 - x0) if quarter % 2 == 0 else (y1 - y0)
        if length < width + 2 * gap:
            return False
        along = self.rng.uniform(width / 2 + gap, length - width / 2 - gap)
        if self.rng.random() < 0.5:  # furniture likes corners
            along = width / 2 + gap if along < length / 2 else length - width / 2 - gap
        origin = ((x0 + along, y0 + gap), (x1 - gap, y0 + along), (x1 - along, y1 - gap),
                  (x0 + gap, y1 - along))[quarter]
        box = {0: Rect(origin[0] - width / 2, origin[1], origin[0] + width / 2, origin[1] + depth),
               1: Rect(origin[0] - depth, origin[1] - width / 2, origin[0],
                       origin[1] + width / 2),
               2: Rect(origin[0] - width / 2, origin[1] - depth, origin[0] + width / 2, origin[1]),
               3: Rect(origin[0], origin[1] - width / 2, origin[0] + depth,
                       origin[1] + width / 2)}[quarter]
        if not self._fits(index, box):
            return False
        piece = Piece(self.builder, origin, quarter, self._next_instance(), self.rng)
        kind.draw(piece, width, depth, height)
        self.builder.end_group()
        self.obstacles.append(Obstacle(box, name))
        return True

    def _fits(self, index: int, box: Rect) -> bool:
        """Inside the room, clear of other furniture and of doors, and no way is blocked."""
        room = self.rooms[index].rect
        if box.x0 < room.x0 or box.y0 < room.y0 or box.x1 > room.x1 or box.y1 > room.y1:
            return False
        for door in self.doors:
            low, high = door.low - 0.1, door.high + 0.1
            zone = (Rect(low, door.at - DOOR_SPACE, high, door.at + DOOR_SPACE) if door.axis == 0
                    else Rect(door.at - DOOR_SPACE, low, door.at + DOOR_SPACE, high))
            if _overlap(box, zone, 0.0):
                return False
        if any(_overlap(box, o.rect, 0.05) for o in self.obstacles if o.label != 'wall'):
            return False
        narrowed = np.minimum(self.clearance,
                              clearance(self.origin, self.shape, np.array([box])))
        free = narrowed > FOOTPRINT_RADIUS + FREE_MARGIN
        reachable = main_component(free)
        # Small pockets behind furniture may be lost, never a way.
        if reachable.sum() < 0.98 * free.sum():
            return False
        self.clearance = narrowed
        return True

    def _decorate(self, index: int) -> None:
        """Pictures and windows on the walls, a rug on the floor."""
        room = self.rooms[index]
        x0, y0, x1, y1 = room.rect
        openings = self._openings(index)
        tall = [o.rect for o in self.obstacles
                if o.label in ('wardrobe', 'bookshelf', 'fridge', 'counter', 'washbasin')]
        outer = {'south': y0 - WALL / 2 < self.outline.y0 + 1e-6,
                 'north': y1 + WALL / 2 > self.outline.y1 - 1e-6,
                 'west': x0 - WALL / 2 < self.outline.x0 + 1e-6,
                 'east': x1 + WALL / 2 > self.outline.x1 - 1e-6}
        for wall in ('south', 'north', 'west', 'east'):
            horizontal = wall in ('south', 'north')
            low, high = (x0, x1) if horizontal else (y0, y1)
            window = outer[wall] and self.rng.random() < 0.6
            width = self.rng.uniform(1.0, 1.5) if window else self.rng.uniform(0.6, 1.1)
            height = self.rng.uniform(1.0, 1.2) if window else width * self.rng.uniform(0.7, 1.2)
            if high - low < width + 0.4:
                continue
            for _ in range(6):
                at = self.rng.uniform(low + width / 2 + 0.15, high - width / 2 - 0.15)
                span = (at - width / 2, at + width / 2)
                if any(span[0] < b + 0.1 and a - 0.1 < span[1] for a, b in openings[wall]):
                    continue
                line = {'south': y0, 'north': y1, 'west': x0, 'east': x1}[wall]
                strip = (Rect(span[0], line - 0.3, span[1], line + 0.3) if horizontal
                         else Rect(line - 0.3, span[0], line + 0.3, span[1]))
                if any(_overlap(strip, rect, 0.0) for rect in tall):
                    continue
                self._hang(wall, line, span, 1.5, height, window)
                break
        if room.kind in ('living_room', 'bedroom', 'office', 'dining_room', 'hall'):
            self._rug(room)
        self.builder.end_group()

    def _hang(self, wall, line, span, centre, height, window) -> None:
        inward = 0.015 if wall in ('south', 'west') else -0.015
        a, b = span if wall in ('north', 'west') else span[::-1]
        z0, z1 = centre - height / 2, min(centre + height / 2, HEIGHT - 0.1)
        if wall in ('south', 'north'):
            points = [(a, line + inward, z0), (b, line + inward, z0), (b, line + inward, z1),
                      (a, line + inward, z1)]
        else:
            points = [(line + inward, a, z0), (line + inward, b, z0), (line + inward, b, z1),
                      (line + inward, a, z1)]
        texture = 'window' if window else f'painting_{int(self.rng.integers(PAINTINGS))}'
        self._add(points, 'window' if window else 'picture', texture, np.full(3, 1.0),
                  self._next_instance(), fit=True)

    def _rug(self, room: Room) -> None:
        x0, y0, x1, y1 = room.rect
        width = (x1 - x0) * self.rng.uniform(0.35, 0.55)
        depth = (y1 - y0) * self.rng.uniform(0.35, 0.55)
        cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
        points = [(cx - width / 2, cy - depth / 2, 0.008), (cx + width / 2, cy - depth / 2, 0.008),
                  (cx + width / 2, cy + depth / 2, 0.008), (cx - width / 2, cy + depth / 2, 0.008)]
        texture = str(self.rng.choice(('dots', 'stripes', 'fabric', 'checker')))
        self._add(points, 'rug', texture, self._colour(FABRICS), self._next_instance(), tile=0.8)


def _overlap(a: Rect, b: Rect, gap: float) -> bool:
    return a.x0 < b.x1 + gap and b.x0 < a.x1 + gap and a.y0 < b.y1 + gap and b.y0 < a.y1 + gap
