"""Pictures of a scene for people: views from all over, and a map."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.floor.floor_map import Rect
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator

VIEW = 200  # pixels a side of a view
COLUMNS = 6
SCALE = 60  # pixels per metre of the map
MARGIN = 0.3  # m around the map

PAPER, FLOOR, WALL, WOOD, GOAL, INK = (
    (250, 250, 250), (244, 240, 232), (57, 66, 79), (226, 214, 194), (42, 98, 201), (60, 66, 75))


def contact_sheet(scene: str, randomisation: Randomisation | None = None, *,
                  pictures: int = 24, seed: int = 0) -> np.ndarray:
    """The goal pictures, views from random places, and below them the map where there is one.

    Args:
        scene: the name of what to show.
        randomisation: of light and camera, drawn anew for every picture.
        pictures: in all; those beside the goal pictures are random views.
        seed: of the random views.

    Returns:
        [H,W,3] uint8 RGB.
    """
    simulator = open_simulator([scene], Setup(1, RobotSpec(), VIEW, randomisation=randomisation))
    place = simulator.places[0]
    rng = np.random.default_rng(seed)
    views = max(0, pictures - len(place.goals))
    centres, headings = place.starts()
    chosen = rng.integers(len(centres), size=views)
    random = np.column_stack([centres[chosen], rng.uniform(-math.pi, math.pi, views) if (
        headings is None) else headings[chosen], np.zeros(views)])
    poses = np.concatenate([[goal.pose for goal in place.goals], random])
    looks = simulator.appearance(seed, Stream.APPEARANCE, np.arange(len(poses)), 0)
    tiles = simulator.view(np.zeros(len(poses), np.int64), poses, None,
                           looks).rgb.transpose(0, 2, 3, 1)
    simulator.close()
    blank = np.full((-len(tiles) % COLUMNS, VIEW, VIEW, 3), PAPER, np.uint8)
    tiles = np.concatenate([tiles, blank])
    rows = [np.concatenate(list(tiles[k:k + COLUMNS]), axis=1)
            for k in range(0, len(tiles), COLUMNS)]
    facts = place.plan()
    if facts is None:  # nobody has a map
        return np.concatenate(rows)
    plan = plan_map(facts)
    width = COLUMNS * VIEW
    height = round(plan.shape[0] * min(1.0, width / plan.shape[1]))
    plan = cv2.resize(plan, (min(width, plan.shape[1]), height), interpolation=cv2.INTER_AREA)
    page = np.full((height + 40, width, 3), PAPER, np.uint8)
    left = (width - plan.shape[1]) // 2
    page[20:20 + height, left:left + plan.shape[1]] = plan
    return np.concatenate([*rows, page])


def plan_map(facts: dict) -> np.ndarray:
    """A place from above, y upwards: walls, furniture, rooms, goals; [H,W,3] uint8 RGB.

    Args:
        facts: of `Place.plan`.
    """
    outline = Rect(*facts['bounds'])
    size = (round((outline.y1 - outline.y0 + 2 * MARGIN) * SCALE),
            round((outline.x1 - outline.x0 + 2 * MARGIN) * SCALE))
    plan = np.full((*size, 3), PAPER, np.uint8)

    def place(x: float, y: float) -> tuple[int, int]:
        return (round((x - outline.x0 + MARGIN) * SCALE),
                size[0] - round((y - outline.y0 + MARGIN) * SCALE))

    def fill(rect, colour) -> None:
        cv2.rectangle(plan, place(rect.x0, rect.y0), place(rect.x1, rect.y1), colour, -1)

    def write(words: str, x: float, y: float, scale: float) -> None:
        cv2.putText(plan, words, place(x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1,
                    cv2.LINE_AA)

    fill(outline, FLOOR)
    for name, colour in (('outside', PAPER), ('walls', WALL), ('obstacles', WOOD)):
        for numbers in facts[name]:
            fill(Rect(*numbers[:4]), colour)
    for *numbers, label in facts['obstacles']:
        rect = Rect(*numbers)
        write(label.replace('_', ' '), rect.x0 + 0.05, (rect.y0 + rect.y1) / 2, 0.34)
    for room in facts['rooms_list']:
        rect = Rect(*room['rect'])
        write(room['name'], rect.x0 + 0.12, rect.y1 - 0.3, 0.5)
    for goal in facts['goals']:
        x, y, yaw, _ = goal['pose']
        cv2.arrowedLine(plan, place(x, y), place(x + 0.6 * math.cos(yaw), y + 0.6 * math.sin(yaw)),
                        GOAL, 3, cv2.LINE_AA, tipLength=0.35)
        cv2.circle(plan, place(x, y), 6, GOAL, -1, cv2.LINE_AA)
    return plan


def write_contact_sheet(path: str | Path, scene: str,
                        randomisation: Randomisation | None = None) -> None:
    """Write the contact sheet as PNG or JPEG, by the file's ending.

    Raises:
        UserError: another ending, or a folder that does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in ('.png', '.jpg', '.jpeg'):
        raise UserError('a contact sheet is a .png or .jpg file', str(path), 'choose such a name')
    if not path.absolute().parent.is_dir():
        raise UserError('the folder of the contact sheet exists', str(path), 'make it first')
    cv2.imwrite(str(path), cv2.cvtColor(contact_sheet(scene, randomisation), cv2.COLOR_RGB2BGR))
