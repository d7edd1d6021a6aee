"""One self-contained HTML page about a recorded drive: figures, maps, film strips."""

from __future__ import annotations

import html
import math
from pathlib import Path

import numpy as np

from vn_nav import __version__
from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_nav.evaluation.bag_episodes import Drive, RecordedEpisode
from vn_nav.evaluation.metrics import path_efficiency
from vn_nav.report.maps import Journey, floor_map
from vn_nav.report.page import cards, page, picture, table
from vn_nav.report.search_map import Window, draw, known_bounds
from vn_nav.report.tables import number
from vn_nav.report.trial_page import outcome, section
from vn_nav.scenes import HOUSE, parse_scene

STRIP = 9  # pictures of a film strip
MAPS, MAP_WIDTH = 4, 520  # of an episode, and pixels
MAP_LEGEND = """<p class="soft">Below the pictures is the policy's own map as it grew, out of
camera and odometry: white is free, dark occupied, grey unknown; thin lines show what is really
there. Green: where it took itself to be. Full arrows: where it took the goal to be, the likeliest
orange. The blue outline is the goal, of which it knew nothing.</p>"""
TITLES = {'trained': 'The {kind} it was trained in', 'unseen': 'A {kind} it has never seen'}


def kind_of(scene: str) -> str:
    """What to call a scene."""
    return 'house' if parse_scene(scene).simulator == HOUSE else 'scene'


def write_report(path: Path, drives: list[Drive], result: dict, trial: dict | None = None) -> None:
    """Write the page.

    Args:
        path: of the HTML file.
        drives: one a place of the figures, trained before unseen; with pictures.
        result: the figures, as in result.json.
        trial: that was driven before, see `trial_page.kept`; None: none was.
    """
    places = [(place, drive) for place, drive in zip(
        (name for name in TITLES if name in result), drives, strict=True)]
    body = ''.join(_place(place, drive, result[place]) for place, drive in places)
    path.write_text(page('vn_nav demo', f"""
<h1>Show a robot a picture, and it drives there</h1>
<p class="soft">Every figure of the demo was counted from the ROS 2 bag of one run: simulator and
policy were two processes that met on ROS topics alone. The policy saw the camera, the goal picture
and its own last action; no true pose, no depth, no map of the house.</p>
{body}
{'' if trial is None else section(trial)}
<h2>Definitions</h2><dl>{_declared_stop([result[place] for place, _ in places])}
<dt>Success</dt><dd>At the end of a decision the robot stands within {ARRIVAL_RADIUS:g} m of the
place (driving distance) and faces within {math.degrees(ARRIVAL_HEADING):g} degrees of the
picture's direction. In brackets the 95 % interval.</dd>
<dt>SPL</dt><dd>Success weighted by path length: 1 means that every journey succeeded on the
shortest way.</dd>
<dt>Collisions</dt><dd>Share of decisions that touched something. The robot does not slide along
walls: a touch ends the movement.</dd>
<dt>Random</dt><dd>Uniform random actions from the same starts to the same goals. Without this
line a success rate says little.</dd></dl>
<p class="soft">vn_nav {__version__},
{result['date']}, {result['seconds']:.0f} s.</p>"""))


def _declared_stop(figures: list[dict]) -> str:
    if not any('false_stops' in own for own in figures):
        return ''
    return """
<dt>Declared stop</dt><dd>Where the figures name it, being there is not enough: the policy itself
has to declare that it has arrived, which ends the episode. Declared elsewhere it is a false
stop.</dd>"""


def _place(place: str, drive: Drive, figures: dict) -> str:
    control = figures['random']
    low, high = figures['success_interval']
    stops = [(f'{figures["false_stops"]:.0%}', 'false stops',
              f'declared {figures["declared"]:.0%}')] if 'false_stops' in figures else []
    boxes = cards([
        (f'{figures["success"]:.0%}', f'success ({low:.0%} to {high:.0%})',
         f'random {control["success"]:.0%}'),
        (number(figures['spl'], '.2f'), 'SPL', f'random {number(control["spl"], ".2f")}'),
        (f'{figures["collisions"]:.1%}', 'decisions with a collision',
         f'random {control["collisions"]:.1%}'),
        (f'{figures["decisions"]:.0f}',
         'decisions an episode ({:.0f} to {:.0f})'.format(*figures['decisions_interval']),
         f'at most {figures["max_decisions"]}; random {control["decisions"]:.0f}'),
        *stops,
    ])
    scene = drive.scene
    rows = table(['goal', 'outcome', 'episode', 'start [m]', 'driven [m]', 'SPL', 'decisions',
                  'collisions', 'stop [m]', 'stop [deg]'],
                 [_row(recorded) for recorded in drive.episodes], text=2)
    chosen = _chosen(drive.episodes)
    journeys = ''.join(_journey(recorded, scene) for recorded in chosen)
    if any(recorded.searches for recorded in chosen):
        journeys = MAP_LEGEND + journeys
    stop = ' Declared stop.' if stops else ''
    limit = '' if place == 'trained' else (
        f' Episodes end at {figures["max_decisions"]} decisions here.')
    size = (f'{len(scene["rooms_list"])} rooms, {scene["area"]:.0f} m&sup2;, '
            if scene.get('rooms_list') else '')
    name = html.escape(scene.get('scene') or f'House {scene["house"]}')
    return f"""<h2>{TITLES[place].format(kind=kind_of(figures['scene']))}</h2>
<p class="soft">{name}: {size}policy {html.escape(figures['checkpoint'])},
{figures['episodes']} episodes, mean start distance
{number(figures['start_distance'], '.1f')} m.{stop}{limit}</p>
{boxes}
<figure>{_map(drive)}<figcaption>Dots are starts, arrows are goals with their viewing direction;
<span class="yes">green</span> journeys arrived, <span class="no">orange</span> ones did
not.</figcaption></figure>
{journeys}
<details><summary>All {len(drive.episodes)} episodes</summary>{rows}</details>"""


def _row(recorded: RecordedEpisode) -> list[str]:
    e = recorded.episode
    kind, words = outcome(e)
    return [html.escape(e.goal), f'<span class="{kind}">{words}</span>',
            str(recorded.facts['episode'] + 1), f'{e.start_distance:.1f}', f'{e.path_length:.1f}',
            f'{path_efficiency(e):.2f}', str(e.decisions), str(e.collisions),
            f'{e.stop_distance:.2f}', f'{math.degrees(e.stop_heading):.0f}']


def _chosen(episodes: list[RecordedEpisode], most: int = 4) -> list[RecordedEpisode]:
    """The longest successful journeys, and one that failed: nothing is hidden."""
    with_pictures = [e for e in episodes if e.goal_picture is not None and e.pictures]
    good = sorted((e for e in with_pictures if e.episode.success),
                  key=lambda e: -e.episode.start_distance)
    bad = [e for e in with_pictures if not e.episode.success]
    return good[:most - min(1, len(bad))] + bad[:1]


def _journey(recorded: RecordedEpisode, plan: dict) -> str:
    assert recorded.goal_picture is not None  # see `_chosen`
    e = recorded.episode
    numbers = sorted(recorded.pictures)
    picked = np.unique(np.linspace(0, len(numbers) - 1, STRIP).round().astype(int))
    frames = ''.join(
        f'<figure><img alt="" src="{picture(recorded.pictures[number])}">'
        f'<figcaption>{"decision " if k == 0 else ""}{number}</figcaption></figure>'
        for k, number in enumerate(numbers[i] for i in picked))
    kind, words = outcome(e)
    way = (f'\nfor a shortest way of {e.start_distance:.1f} m'
           if math.isfinite(e.start_distance) else '')  # else nobody knows it
    return f"""<div class="journey"><h3>To the {html.escape(e.goal)}:
<span class="{kind}">{words}</span>
<small>after {e.decisions} decisions, {e.path_length:.1f} m{way}</small></h3>
<div class="strip">
<figure class="goal"><img alt="goal picture" src="{picture(recorded.goal_picture)}">
<figcaption>goal picture</figcaption></figure>{frames}</div>{_maps(recorded, plan)}</div>"""


def _maps(recorded: RecordedEpisode, plan: dict) -> str:
    """How the map of a policy that searches grew; '': it is another, or nobody listened."""
    numbers = sorted(recorded.searches)
    if not numbers:
        return ''
    picked = np.unique(np.linspace(0, len(numbers) - 1, MAPS).round().astype(int))
    last = recorded.searches[numbers[-1]]
    bounds = plan['bounds'] if 'bounds' in plan else known_bounds(last.search, last.frame)
    x0, y0, x1, y1 = bounds
    view = Window.about(bounds, MAP_WIDTH, round(MAP_WIDTH * (y1 - y0 + 1) / (x1 - x0 + 1)))
    figures: list[str] = []
    for count in (numbers[k] for k in picked):
        known = recorded.searches[count]
        drawn = draw(known.search, view, known.frame, plan=plan if 'bounds' in plan else None,
                     goal=recorded.facts['goal_pose'])
        figures.append(f'<figure><img alt="map" src="{picture(drawn)}"><figcaption>'
                       f'{"" if figures else "its map at decision "}{count}'
                       '</figcaption></figure>')
    return f'<div class="strip grown">{"".join(figures)}</div>'


def _map(drive: Drive) -> str:
    if 'bounds' not in drive.scene:
        return ''  # nobody has a map
    return floor_map(drive.scene,
                     [Journey(e.trajectory, e.episode.success) for e in drive.episodes],
                     [goal['pose'] for goal in drive.scene['goals']])
