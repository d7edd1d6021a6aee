"""A move that has led nowhere is not tried again from the same spot, and turning has an end."""

import math

import numpy as np
import pytest
import torch

from vn_nav.policy.spot import AGAIN, BACK, RESTLESS, SEEN, SpotMemory

TURN = math.radians(30)
MOVES = ((0.5, 0, 0), (-0.2, 0, 0), (0, 0, TURN), (0, 0, -TURN))
FORWARD, BACKWARD, LEFT, RIGHT = range(4)
NO, YES = torch.zeros(1, dtype=torch.bool), torch.ones(1, dtype=torch.bool)


class Walker:
    """One robot whose pictures are random and the same in the same place; with noise."""

    def __init__(self, moves=MOVES, seed=0):
        self.random = np.random.default_rng(seed)
        self.memory = SpotMemory(moves, 1)
        self.scene = self._draw()

    def _draw(self):
        coarse = self.random.integers(0, 256, (3, 8, 8))
        return coarse.repeat(8, axis=1).repeat(8, axis=2)

    def sees(self, last, starts=NO, new=True):
        if new:
            self.scene = self._draw()
        noisy = np.clip(self.scene + self.random.normal(0, 8, self.scene.shape), 0, 255)
        return self.memory.advise(torch.from_numpy(noisy.astype(np.uint8))[None],
                                  torch.tensor([last]), starts)[0].tolist()


@pytest.fixture
def stuck():
    """Stands at a wall, and has tried to drive on."""
    walker = Walker()
    assert walker.sees(-1, YES) == [0, 0, 0, 0]
    assert walker.sees(FORWARD, new=False) == [-AGAIN, 0, 0, 0]
    return walker


def test_what_led_nowhere_is_not_done_again_nor_faced_again(stuck):
    assert stuck.sees(LEFT) == [0, 0, 0, -BACK]  # the way back to face the wall
    assert stuck.sees(FORWARD, new=False) == [-AGAIN, 0, 0, -BACK]  # a corner
    assert stuck.sees(LEFT) == [0, 0, 0, -BACK]
    assert stuck.sees(RIGHT) == [-AGAIN, 0, 0, -BACK]
    assert stuck.sees(BACKWARD, new=False) == [-AGAIN, -AGAIN, 0, -BACK]


def test_all_around_comes_back_to_the_wall(stuck):
    for _ in range(11):
        said = stuck.sees(LEFT)
    assert said[1:] == [0, -BACK, 0]
    assert stuck.sees(LEFT) == pytest.approx([-AGAIN + (2 * math.pi - SEEN) / RESTLESS, 0, 0, 0])


def test_who_turns_to_and_fro_drives_on_at_last():
    walker = Walker()
    walker.sees(-1, YES)
    said = [walker.sees((LEFT, RIGHT)[k % 2])[FORWARD] for k in range(12)]
    assert said == pytest.approx([max(k * TURN - SEEN, 0) / RESTLESS for k in range(1, 13)])
    assert said[6] == 0 < said[8] < said[-1]
    assert walker.sees(FORWARD) == [0, 0, 0, 0]


def test_who_has_moved_on_is_free(stuck):
    stuck.sees(LEFT)
    assert stuck.sees(FORWARD) == [0, 0, 0, 0]
    assert stuck.sees(RIGHT) == [0, 0, 0, 0]


@pytest.mark.parametrize('last, starts', [(-1, NO), (FORWARD, YES)], ids=['moved', 'begins'])
def test_who_was_moved_or_begins_knows_nothing(stuck, last, starts):
    assert stuck.sees(last, starts, new=False) == [0, 0, 0, 0]


def test_a_turn_that_shows_the_same_is_no_contact():
    walker = Walker()
    walker.sees(-1, YES)
    assert walker.sees(LEFT, new=False) == [0, 0, 0, 0]


def test_robots_have_memories_of_their_own():
    memory = SpotMemory(MOVES, 3)
    pictures = torch.randint(0, 256, (3, 3, 64, 64), dtype=torch.uint8)
    pictures[:, :, :32] //= 4  # so that another picture differs, averaged, too
    memory.advise(pictures, torch.tensor([-1, -1, -1]), torch.ones(3, dtype=torch.bool))
    pictures[1] = 255 - pictures[1]
    said = memory.advise(pictures, torch.tensor([FORWARD, FORWARD, BACKWARD]),
                         torch.zeros(3, dtype=torch.bool))
    assert said.tolist() == [[-AGAIN, 0, 0, 0], [0, 0, 0, 0], [0, -AGAIN, 0, 0]]
