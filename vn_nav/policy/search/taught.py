"""What a recorded drive gives a robot that searches: key pictures with poses, and a map.

All of it lies in the frame of the drive.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vn_nav.errors import UserError

MOST_SIDE = 4096  # cells of a map


@dataclasses.dataclass(frozen=True)
class TaughtPlace:
    """A place that was driven through.

    Raises:
        UserError: parts that do not belong together, or values that are none.
    """

    pictures: np.ndarray  # [K,3,S,S] uint8
    poses: np.ndarray  # [K,3] float32 x, y [m], yaw [rad] where they were taken
    log_odds: np.ndarray  # [R,C] float32, as of an `OccupancyGrid`
    seen: np.ndarray  # [R,C] float32
    lane: np.ndarray  # [R,C] float32: 1 where the robot's centre was
    origin: np.ndarray  # [2] float32 m, of the map's lower left corner
    zoom: np.ndarray  # [1] float32: of the pictures' lens, see `vn_nav.policy.search.lens`

    def __post_init__(self):
        count, side = len(self.poses), self.log_odds.shape
        fits = (self.pictures.ndim == 4 and count >= 1 and self.pictures.dtype == np.uint8
                and self.pictures.shape[:2] == (count, 3)
                and self.pictures.shape[2] == self.pictures.shape[3]
                and self.poses.shape == (count, 3) and len(side) == 2
                and self.seen.shape == self.lane.shape == side
                and 1 <= min(side) and max(side) <= MOST_SIDE
                and self.origin.shape == (2,) and self.zoom.shape == (1,))
        if not fits:
            raise UserError('a taught place has key pictures, a pose for each, and a map',
                            ', '.join(f'{field.name} {getattr(self, field.name).shape}'
                                      for field in dataclasses.fields(self)), 'teach it again')
        for name in ('poses', 'log_odds', 'seen', 'lane', 'origin', 'zoom'):
            part = getattr(self, name)
            if part.dtype != np.float32 or not np.isfinite(part).all():
                raise UserError('numbers of a taught place are finite, of 32 bits',
                                f'{name} {part.dtype}', 'teach it again')
        if not 0.1 < self.zoom[0] < 10:
            raise UserError('the lens of a taught place magnifies 0.1 to 10 times', self.zoom[0],
                            'teach it again')
