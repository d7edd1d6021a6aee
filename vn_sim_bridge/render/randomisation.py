"""Domain randomisation: what differs from one episode, or one picture, to the next.

Everything is drawn from the counter (seed, environment, episode), so that a seed reproduces it.
A goal picture draws light and camera effects of its own, as a picture taken last week would.
"""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vn_nav.errors import UserError
from vn_nav.resources import share_file
from vn_nav.structured_file import read_yaml
from vn_sim_bridge.counter_random import Stream, normal, uniform
from vn_sim_bridge.render.pack import FACING

Range = tuple[float, float]
LIMITS = {'daylight': (0, 4), 'daylight_kelvin': (1500, 20000), 'sun': (0, 4), 'lamp': (0, 4),
          'lamp_kelvin': (1500, 20000), 'exposure': (-4, 4), 'fov_deg': (-45, 45),
          'height': (-0.5, 0.5), 'pitch_deg': (-45, 45), 'noise': (0, 80), 'blur': (0, 0.2),
          'motion_scale': (0.2, 2), 'command_delay': (0, 1), 'motor_lag': (0, 1),
          'camera_delay': (0, 1)}
MOST_WHITE_BALANCE = 0.5
BASE = ('motion_scale', 'slip', 'late_picture', 'command_delay', 'motor_lag', 'camera_delay')
LIGHT = ('daylight', 'daylight_kelvin', 'sun', 'lamp', 'lamp_kelvin', 'exposure')


@dataclasses.dataclass(frozen=True)
class Randomisation:
    """Ranges (least, greatest) of uniform draws. The defaults vary nothing."""

    # Light, an episode.
    daylight: Range = (0.62, 0.62)  # level of the light that comes from everywhere
    daylight_kelvin: Range = (6500.0, 6500.0)  # its colour temperature
    sun: Range = (0.0, 0.0)  # level of light from one direction; where from is uniform
    lamp_on: float = 1.0  # probability that a room's lamp is on
    lamp: Range = (0.5, 0.5)  # its level
    lamp_kelvin: Range = (6500.0, 6500.0)
    # Camera, an episode.
    exposure: Range = (0.0, 0.0)  # stops (factors of two)
    white_balance: float = 0.0  # standard deviation of each channel's gain
    fov_deg: Range = (0.0, 0.0)  # deg, added to the robot's
    height: Range = (0.0, 0.0)  # m, added
    pitch_deg: Range = (0.0, 0.0)  # deg down, added
    # Sensor, each picture.
    noise: Range = (0.0, 0.0)  # standard deviation [grey levels], drawn an episode
    blur: Range = (0.0, 0.0)  # length of horizontal motion blur as a share of the width
    # The base.
    motion_scale: Range = (1.0, 1.0)  # metres driven per metre asked for, an episode
    slip: float = 0.0  # probability that a decision moves only a part of what was asked
    late_picture: float = 0.0  # probability that a picture is the one before
    # Of time, an episode: only a robot that is driven by velocities (the bridge) has any.
    command_delay: Range = (0.0, 0.0)  # s until a velocity reaches the wheels' controller
    motor_lag: Range = (0.0, 0.0)  # s, time constant of the motors
    camera_delay: Range = (0.0, 0.0)  # s from a picture's stamp until it is published
    goal_variants: int = 8  # differently lit pictures of each goal; 1 where nothing varies

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(field.default, tuple):
                if (not isinstance(value, (tuple, list)) or len(value) != 2
                        or not all(isinstance(v, (int, float)) and math.isfinite(v)
                                   for v in value) or value[0] > value[1]):
                    raise UserError(f'{field.name} is a range: two numbers, the lesser first',
                                    value, 'correct the randomisation')
                object.__setattr__(self, field.name, (float(value[0]), float(value[1])))
        for name, (least, greatest) in LIMITS.items():
            low, high = getattr(self, name)
            if low < least or high > greatest:
                raise UserError(f'{name} lies within {least} and {greatest}', (low, high),
                                'correct the randomisation')
        for name, greatest in (('lamp_on', 1), ('slip', 1), ('late_picture', 1),
                               ('white_balance', MOST_WHITE_BALANCE)):
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and 0 <= value <= greatest):
                raise UserError(f'{name} lies within 0 and {greatest}', value,
                                'correct the randomisation')
        if not isinstance(self.goal_variants, int) or not 1 <= self.goal_variants <= 256:
            raise UserError('goal_variants is a whole number from 1 to 256', self.goal_variants,
                            'correct the randomisation')

    @property
    def varies_pictures(self) -> bool:
        """Whether two pictures from one pose can differ."""
        others = (*BASE, 'goal_variants')
        return any(getattr(self, field.name) != field.default
                   for field in dataclasses.fields(self) if field.name not in others)

    @property
    def varies_time(self) -> bool:
        """Whether commands, motors or pictures are late."""
        return any(getattr(self, name) != (0.0, 0.0)
                   for name in ('command_delay', 'motor_lag', 'camera_delay'))

    def with_light(self, spread: float) -> Randomisation:
        """With ranges of light and exposure `spread` times as wide, as far as `LIMITS` allow.

        Their middles stay. Lamps are off `spread` times as often. 0: one light for all.
        """
        def spread_out(name: str) -> Range:
            low, high = getattr(self, name)
            least, greatest = LIMITS[name]
            more = (spread - 1) * (high - low) / 2
            return max(low - more, least), min(high + more, greatest)

        changed: dict[str, Any] = {name: spread_out(name) for name in LIGHT}
        return dataclasses.replace(
            self, lamp_on=max(self.lamp_on - (spread - 1) * (1 - self.lamp_on), 0.0),
            white_balance=min(spread * self.white_balance, MOST_WHITE_BALANCE), **changed)

    def with_camera(self, exposure: float = 0.0, blur: float | None = None) -> Randomisation:
        """With stops added to the exposure, and one length of motion blur.

        Args:
            exposure: stops.
            blur: share of the width; None: as it is.

        Raises:
            UserError: beyond `LIMITS`.
        """
        low, high = self.exposure
        return dataclasses.replace(self, exposure=(low + exposure, high + exposure),
                                   blur=self.blur if blur is None else (blur, blur))

    def of_the_base(self) -> Randomisation:
        """What it varies of the base alone: for simulators that draw no light."""
        return Randomisation(**{name: getattr(self, name) for name in BASE})

    @property
    def pictures_per_goal(self) -> int:
        """Differently lit pictures kept of each goal."""
        return self.goal_variants if self.varies_pictures else 1


class Appearance(NamedTuple):
    """Light and camera of K pictures."""

    cube: np.ndarray  # [K,6,3] float32, see `pack.Lights`
    lamps: np.ndarray  # [K,R,3] float32
    fov: np.ndarray  # [K] float64 rad, added to the robot's
    height: np.ndarray  # [K] float64 m, added
    pitch: np.ndarray  # [K] float64 rad, added
    noise: np.ndarray  # [K] float32 grey levels
    blur: np.ndarray  # [K] float32, share of the width


def draw_appearance(config: Randomisation, rooms: int, seed: int | np.ndarray, stream: Stream,
                    env, episode) -> Appearance:
    """Light and camera of some episodes.

    Args:
        config: what may vary.
        rooms: lamps to draw.
        seed, stream: of the random numbers.
        env, episode: [K] counters (a goal's: index of the goal, index of the variant).
    """
    env, episode = np.atleast_1d(env), np.atleast_1d(episode)

    def within(limits: Range, index: int) -> np.ndarray:
        return limits[0] + (limits[1] - limits[0]) * uniform(seed, stream, env, episode, index)

    gains = 2.0 ** within(config.exposure, 0)[:, None] * np.stack(
        [1 + config.white_balance * normal(seed, stream, env, episode, 1 + c)
         for c in range(3)], axis=1)
    gains = np.maximum(gains, 0.05)
    daylight = within(config.daylight, 4)[:, None] * blackbody(within(config.daylight_kelvin, 5))
    azimuth = 2 * math.pi * uniform(seed, stream, env, episode, 6)
    sun = within(config.sun, 7)[:, None]
    towards = np.stack([np.cos(azimuth), -np.cos(azimuth), np.sin(azimuth), -np.sin(azimuth),
                        np.full_like(azimuth, 0.5), np.zeros_like(azimuth)], axis=1)
    cube = (FACING[None, :, None] * daylight[:, None, :]
            + np.maximum(towards, 0)[:, :, None] * sun[:, None, :])
    lamp = within(config.lamp, 8)[:, None] * blackbody(within(config.lamp_kelvin, 9))
    on = np.stack([uniform(seed, stream, env, episode, 32 + room) < config.lamp_on
                   for room in range(rooms)], axis=1)
    return Appearance(
        cube=(cube * gains[:, None, :]).astype(np.float32),
        lamps=(on[:, :, None] * (lamp * gains)[:, None, :]).astype(np.float32),
        fov=np.radians(within(config.fov_deg, 10)),
        height=within(config.height, 11),
        pitch=np.radians(within(config.pitch_deg, 12)),
        noise=within(config.noise, 13).astype(np.float32),
        blur=within(config.blur, 14).astype(np.float32),
    )


def blackbody(kelvin: np.ndarray) -> np.ndarray:
    """Colour [K,3] of light of a temperature, relative to 6500 K, mean 1.

    A smooth fit to the locus in linear sRGB: red falls and blue rises with the temperature.
    """
    ratio = np.asarray(kelvin, float) / 6500.0
    colour = np.stack([ratio**-0.55, np.ones_like(ratio), ratio**0.75], axis=-1)
    return colour / colour.mean(axis=-1, keepdims=True)


def load_randomisation(name: str | Path) -> Randomisation:
    """Read a randomisation: 'none', a name in config/randomisation/, or a YAML file.

    Raises:
        UserError: a missing file, an unknown field or a value outside its range.
    """
    if str(name) == 'none':
        return Randomisation()
    path = Path(name)
    if re.fullmatch('[a-z_0-9]+', str(name)) and not path.exists():
        path = share_file(f'config/randomisation/{name}.yaml')
    if not path.is_file():
        raise UserError("a randomisation is 'none', 'standard', 'rough', 'harsh' or a YAML file",
                        str(name), 'see config/randomisation/ for examples')
    data = read_yaml(path, 'a randomisation file', 'see config/randomisation/ for examples')
    known = {field.name for field in dataclasses.fields(Randomisation)}
    if unknown := sorted(set(map(str, data)) - known):
        raise UserError('a randomisation file has only known fields',
                        f'{path}: {", ".join(unknown)}', 'the fields are '
                        + ', '.join(sorted(known)))
    return Randomisation(**data)
