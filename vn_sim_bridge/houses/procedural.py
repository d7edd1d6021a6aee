"""Seeded procedural houses: the same seed and room count give the same house."""

from __future__ import annotations

import numpy as np

from vn_nav.errors import UserError
from vn_nav.scenes import house_scene
from vn_sim_bridge.floor.floor_map import (
    FREE_MARGIN,
    Room,
    clearance,
    floor_map,
    grid_of,
    main_component,
)
from vn_sim_bridge.houses.bake import light_baker
from vn_sim_bridge.houses.furniture import (
    DRAWINGS,
    KINDS,
    OPTIONAL_PROBABILITY,
    ROOM_PROGRAMMES,
    TALL,
)
from vn_sim_bridge.houses.house import House, Obstacle
from vn_sim_bridge.houses.labels import LABEL
from vn_sim_bridge.houses.layout import (
    WALL,
    Door,
    Rect,
    bounds,
    contacts,
    outside,
    place_doors,
    wall_obstacles,
    wings,
)
from vn_sim_bridge.houses.piece import Piece
from vn_sim_bridge.houses.splits import look_of
from vn_sim_bridge.houses.textures import TEXTURES, texture_library
from vn_sim_bridge.houses.viewpoints import choose_goals
from vn_sim_bridge.render.scene import SceneBuilder
from vn_sim_bridge.simulator import Goal

HEIGHT = 2.6  # m, of rooms
DOOR_HEIGHT = 2.05  # m
ROOM_AREA = 15.0  # m^2, mean area of a room between wall centres
MAX_ROOMS = 12
TWO_WINGS_FROM = 4  # rooms
TWO_WINGS = 0.4  # share of such houses
GAP = 0.01  # m between furniture and walls
DOOR_SPACE = 0.75  # m in front of a door that furniture leaves free
FOOTPRINT_RADIUS = 0.18  # m, the standard robot

# Room types in the order in which a house gets them.
ROOM_ORDER = ('living_room', 'kitchen', 'bedroom', 'bathroom', 'office', 'dining_room', 'bedroom',
              'hall', 'bathroom', 'bedroom', 'office', 'living_room')


def generate_house(seed: int, *, rooms: int = 5, goals_per_room: int = 1,
                   goal_seed: int = 0) -> House:
    """Build a house.

    Args:
        seed: 0 to 12,999 (see `splits`); equal seeds give equal houses.
        rooms: number of rooms, 1 to 12. From four on there may be a second wing.
        goals_per_room: places in each room where goal pictures are taken.
        goal_seed: 0: the house's own goals; else other ones, by the same rule, in the same house.

    Raises:
        UserError: a seed or a number of rooms outside its range.
    """
    if not isinstance(seed, (int, np.integer)):
        raise UserError('the seed of a house is a whole number', seed, 'choose another')
    look = look_of(seed)
    if not 1 <= rooms <= MAX_ROOMS:
        raise UserError(f'a house has 1 to {MAX_ROOMS} rooms', rooms, 'choose a number in range')
    if not 1 <= goals_per_room <= 16:
        raise UserError('a room has 1 to 16 goals', goals_per_room, 'choose a number in range')
    if goal_seed < 0:
        raise UserError('the seed of goals is not negative', goal_seed, 'choose another')
    rng = np.random.default_rng([seed, rooms])
    count = 2 if rooms >= TWO_WINGS_FROM and rng.random() < TWO_WINGS else 1
    while True:  # a floor plan without doors for every room is drawn again; seldom more than twice
        parts = wings(rooms, ROOM_AREA, rng, count)
        cells = [cell for part in parts for cell in part]
        doors = place_doors(cells, rng)
        if doors is not None:
            break
    goals = np.random.default_rng([seed, rooms, goal_seed]) if goal_seed else rng
    return _Construction(seed, look, parts, doors, rng).house(goals_per_room, goals)


class _Construction:
    """The state while one house is built: surfaces, then furniture, then goals."""

    def __init__(self, seed, look, parts: list[list[Rect]], doors: list[Door],
                 rng: np.random.Generator):
        self.seed, self.look, self.doors, self.rng = seed, look, doors, rng
        self.cells = [cell for part in parts for cell in part]
        self.outline = bounds(self.cells)
        self.builder = SceneBuilder(texture_library())
        self.instance = 0
        self.obstacles = [Obstacle(rect, 'wall') for rect in wall_obstacles(self.cells, doors)]
        self.obstacles += [Obstacle(rect, 'outside') for rect in outside(
            self.outline, [bounds(part) for part in parts])]
        self.rooms = self._name_rooms()
        self.origin, self.shape = grid_of(self.outline)
        self.clearance = clearance(self.origin, self.shape,
                                   np.array([o.rect for o in self.obstacles]))

    def house(self, goals_per_room: int, goal_rng: np.random.Generator) -> House:
        """Run the construction."""
        for index in range(len(self.rooms)):
            self.builder.room = index
            self._surfaces(index)
        for door in self.doors:
            self.builder.room = door.first
            self._doorway(door)
        for index in range(len(self.rooms)):
            self.builder.room = index
            self._furnish(index)
        for index in range(len(self.rooms)):
            self.builder.room = index
            self._decorate(index)
        lamps = [((room.rect.x0 + room.rect.x1) / 2, (room.rect.y0 + room.rect.y1) / 2,
                  HEIGHT - 0.35) for room in self.rooms]
        scene = self.builder.build(light_baker(
            np.array(lamps), np.array([self.outline.x0, self.outline.y0, 0.0]),
            np.array([self.outline.x1, self.outline.y1, HEIGHT])))
        floor = floor_map(self.outline, np.array([o.rect for o in self.obstacles]),
                          FOOTPRINT_RADIUS)
        goals = choose_goals(scene, self.rooms, floor, goal_rng, goals_per_room)
        return House(house_scene(self.seed, len(self.rooms)), self.seed, self.outline, scene,
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
        rooms: list[Room] = []
        seen: dict[str, int] = {}
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
        found: dict[str, list[tuple[float, float]]] = {
            'south': [], 'north': [], 'west': [], 'east': []}
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
        look = self.look
        floor_texture = self.rng.choice(look.wet_floor_textures if wet
                                        else look.dry_floor_textures)
        floor_colour = self._colour(look.wet_floors if wet else look.woods + look.fabrics[3:4])
        wall_texture = str(self.rng.choice(look.wall_textures))
        wall_colour = self._colour(look.walls)
        instance = self._next_instance()
        self._add([(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)], 'floor',
                  str(floor_texture), floor_colour, instance, tile=1.6)
        self._add([(x0, y1, HEIGHT), (x1, y1, HEIGHT), (x1, y0, HEIGHT), (x0, y0, HEIGHT)],
                  'ceiling', 'plaster', self._colour(look.whites, 0.02), self._next_instance(),
                  tile=1.5)
        self.builder.end_group()
        openings = self._openings(index)
        # Each wall from its left to its right end, seen from inside the room.
        ends = {'south': ((x1, y0), (x0, y0)), 'north': ((x0, y1), (x1, y1)),
                'west': ((x0, y0), (x0, y1)), 'east': ((x1, y1), (x1, y0))}
        for wall, corners in ends.items():
            instance = self._next_instance()
            start, end = map(np.array, corners)
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
        wood = self._colour(self.look.woods + self.look.whites)
        instance = self._next_instance()

        def place(along, across, z):
            return (along, door.at + across, z) if door.axis == 0 else (door.at + across, along, z)

        quads: dict[str, list[tuple[float, float, float]]] = {
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
            self._add(points, 'door', self.look.wood, wood, instance)
        self.builder.end_group()

    def _furnish(self, index: int) -> None:
        """The room type's programme; then pieces of its optional part, some of the time."""
        optional = False
        for name in ROOM_PROGRAMMES[self.rooms[index].kind]:
            if name is None:
                optional = True
            elif not optional or self.rng.random() < OPTIONAL_PROBABILITY:
                for _ in range(12):
                    if self._try_piece(index, name):
                        break

    def _try_piece(self, index: int, name: str) -> bool:
        """Put a piece at a random wall, or into the middle; False when it does not fit there."""
        room, kind = self.rooms[index], KINDS[name]
        width, depth, height = (self.rng.uniform(*span)
                                for span in (kind.width, kind.depth, kind.height))
        quarter = int(self.rng.integers(4))
        # Quarter 0 stands at the south wall and faces north; each further one turns left.
        x0, y0, x1, y1 = room.rect
        deep = depth + kind.standing
        length = (x1 - x0) if quarter % 2 == 0 else (y1 - y0)
        inwards = (y1 - y0) if quarter % 2 == 0 else (x1 - x0)
        if length < width + 2 * GAP or inwards < deep + 2 * GAP:
            return False
        if kind.centre:
            along = length / 2 + self.rng.uniform(-0.2, 0.2) * (length - width)
            gap = (inwards - deep) / 2 + self.rng.uniform(-0.15, 0.15) * (inwards - deep)
        else:
            gap = GAP
            along = self.rng.uniform(width / 2 + gap, length - width / 2 - gap)
            if self.rng.random() < 0.5:  # furniture likes corners
                along = width / 2 + gap if along < length / 2 else length - width / 2 - gap
        origin = ((x0 + along, y0 + gap), (x1 - gap, y0 + along), (x1 - along, y1 - gap),
                  (x0 + gap, y1 - along))[quarter]
        half = width / 2
        box = (Rect(origin[0] - half, origin[1], origin[0] + half, origin[1] + deep),
               Rect(origin[0] - deep, origin[1] - half, origin[0], origin[1] + half),
               Rect(origin[0] - half, origin[1] - deep, origin[0] + half, origin[1]),
               Rect(origin[0], origin[1] - half, origin[0] + deep, origin[1] + half))[quarter]
        if not self._fits(index, box):
            return False
        piece = Piece(self.builder, self.look, origin, quarter, self._next_instance(), self.rng)
        DRAWINGS[name](piece, width, depth, height)
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
        if any(_overlap(box, o.rect, 0.05) for o in self.obstacles
               if o.label not in ('wall', 'outside')):
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
        tall = [o.rect for o in self.obstacles if o.label in TALL]
        inner = self._inner_stretches(index)
        for wall in ('south', 'north', 'west', 'east'):
            horizontal = wall in ('south', 'north')
            low, high = (x0, x1) if horizontal else (y0, y1)
            window = self.rng.random() < 0.6
            width = self.rng.uniform(1.0, 1.5) if window else self.rng.uniform(0.6, 1.1)
            height = self.rng.uniform(1.0, 1.2) if window else width * self.rng.uniform(0.7, 1.2)
            if high - low < width + 0.4:
                continue
            for _ in range(6):
                at = self.rng.uniform(low + width / 2 + 0.15, high - width / 2 - 0.15)
                span = (at - width / 2, at + width / 2)
                if any(span[0] < b + 0.1 and a - 0.1 < span[1] for a, b in openings[wall]):
                    continue
                if window and any(span[0] < b and a < span[1] for a, b in inner[wall]):
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
        self._ceiling_lamp(room)

    def _inner_stretches(self, index: int) -> dict[str, list[tuple[float, float]]]:
        """Parts of a room's walls with another room behind them, by wall."""
        found: dict[str, list[tuple[float, float]]] = {
            'south': [], 'north': [], 'west': [], 'east': []}
        for contact in contacts(self.cells):
            if index == contact.first:
                found['north' if contact.axis == 0 else 'east'].append((contact.low, contact.high))
            if index == contact.second:
                found['south' if contact.axis == 0 else 'west'].append((contact.low, contact.high))
        return found

    def _ceiling_lamp(self, room: Room) -> None:
        origin = ((room.rect.x0 + room.rect.x1) / 2, (room.rect.y0 + room.rect.y1) / 2)
        piece = Piece(self.builder, self.look, origin, 0, self._next_instance(), self.rng)
        piece.cylinder(0, 0, 0.015, HEIGHT - 0.25, HEIGHT, 'lamp', 'plain', piece.metal, sides=3,
                       lid=False)
        piece.shade(0, 0, 0.22, HEIGHT - 0.45, HEIGHT - 0.25)
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
        texture, label = str(self.rng.choice(self.look.paintings)), 'picture'
        if window:
            texture = label = 'window'
        elif self.rng.random() < 0.08:
            texture = label = 'clock'
        self._add(points, label, texture, np.full(3, 1.0), self._next_instance(), fit=True)

    def _rug(self, room: Room) -> None:
        x0, y0, x1, y1 = room.rect
        width = (x1 - x0) * self.rng.uniform(0.35, 0.55)
        depth = (y1 - y0) * self.rng.uniform(0.35, 0.55)
        cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
        points = [(cx - width / 2, cy - depth / 2, 0.008), (cx + width / 2, cy - depth / 2, 0.008),
                  (cx + width / 2, cy + depth / 2, 0.008), (cx - width / 2, cy + depth / 2, 0.008)]
        texture = str(self.rng.choice(self.look.rug_textures))
        self._add(points, 'rug', texture, self._colour(self.look.fabrics),
                  self._next_instance(), tile=0.8)


def _overlap(a: Rect, b: Rect, gap: float) -> bool:
    return a.x0 < b.x1 + gap and b.x0 < a.x1 + gap and a.y0 < b.y1 + gap and b.y0 < a.y1 + gap
