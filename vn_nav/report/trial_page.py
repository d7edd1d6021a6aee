"""The page of `vn_nav drive-trial`: an ideal base and a harsh one, on the same starts.

A trial takes hours. What is kept of it with the policy (`kept`) makes a part of the demo's page
(`section`).
"""

from __future__ import annotations

import html
import math

import numpy as np

from vn_nav import __version__
from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_nav.evaluation.bag_episodes import Drive
from vn_nav.evaluation.metrics import Episode
from vn_nav.report.maps import Journey, floor_map
from vn_nav.report.page import page, table
from vn_nav.report.tables import number

STEP_M = 0.1  # between two kept places of a way
SHOWN = 10  # ways in a part of another page
# What a floor map is drawn of.
PLAN = 'scene', 'bounds', 'walls', 'outside', 'obstacles', 'rooms_list'


def trial_page(result: dict, about: dict[str, str], drives: dict[str, list[Drive]]) -> str:
    """The page.

    Args:
        result: figures of every base, as in result.json.
        about: what each base is like; a sentence that begins with a verb.
        drives: of each base, one a scene.
    """
    bases = ''.join(f'<dt>{base.capitalize()}</dt><dd>It {html.escape(text)}</dd>'
                    for base, text in about.items())
    scenes = ''.join(_scene({base: own[k] for base, own in drives.items()})
                     for k in range(min(map(len, drives.values()))))
    return page('vn_nav drive-trial', f"""
<h1>Drive trial: an ideal base, and a harsh one</h1>
<p class="soft">Policy {html.escape(result['checkpoint'])} over ROS 2, simulator and policy as two
processes. Both bases have the limits of {html.escape(result['robot'])}, the same houses, starts
and goals, at most {result['max_decisions']} decisions. Every figure was counted from the
bags.</p>
{_compared(result["bases"])}{_difference(result)}
<h2>The bases</h2><dl>{bases}</dl>
<h2>Scene by scene</h2>
<p class="soft">Dots are starts, arrows are goals with their viewing direction;
<span class="yes">green</span> journeys arrived, <span class="no">orange</span> ones did not.</p>
{scenes}
<h2>Definitions</h2><dl><dt>Success</dt><dd>The robot comes to rest within {ARRIVAL_RADIUS:g} m of
the place of the picture (driving distance) and within {math.degrees(ARRIVAL_HEADING):g} degrees of
its direction; where false stops are counted, it says so itself. In brackets the 95 %
interval.</dd><dt>Stop</dt><dd>Of the successful episodes, in a straight line: the median, and what
nine of ten keep within.</dd><dt>Collisions</dt><dd>Share of decisions that touched
something.</dd><dt>Interventions</dt><dd>Stops that policy_node latched (a silent camera, say), and
that the trial reset.</dd></dl>
<p class="soft">vn_nav {__version__}, {html.escape(result['machine'])}, {result['date']}.</p>""")


def kept(result: dict, about: dict[str, str], drives: dict[str, list[Drive]]) -> dict:
    """What stays of a trial, for JSON: figures, floors, ways of some cm.

    Args:
        result, about, drives: see `trial_page`.
    """
    return {'result': result, 'about': about, 'scenes': [{
        'plan': {name: drive.scene[name] for name in PLAN if name in drive.scene},
        'drives': [{'success': one.episode.success, 'outcome': outcome(one.episode)[1],
                    'goal': [round(value, 2) for value in one.facts['goal_pose'][:3]],
                    'decisions': one.episode.decisions, 'seconds': round(one.episode.seconds),
                    'way': _thinned(one.trajectory).round(2).tolist()}
                   for one in drive.episodes]}
        for drive in drives.get('harsh', ())]}


def _thinned(trajectory: np.ndarray) -> np.ndarray:
    """Places [K,2] along a way, `STEP_M` apart, and its end."""
    places = [trajectory[0, :2]]
    for place in trajectory[1:, :2]:
        if math.dist(place, places[-1]) >= STEP_M:
            places.append(place)
    return np.array([*places, trajectory[-1, :2]])


def section(trial: dict) -> str:
    """A part of another page: the table, and the ways of the harsh base.

    Args:
        trial: of `kept`.
    """
    result, shown = trial['result'], []
    # The first drive of each scene, the second, and so on; shown scene by scene.
    drives = sorted(((turn, number, one) for number, scene in enumerate(trial['scenes'])
                     if 'bounds' in scene['plan'] for turn, one in enumerate(scene['drives'])),
                    key=lambda entry: entry[:2])[:SHOWN]
    for _, scene_number, one in sorted(drives, key=lambda entry: entry[1::-1]):
        plan, way = trial['scenes'][scene_number]['plan'], np.array(one['way'])
        drawn = floor_map(plan, [Journey(way, one['success'])], [one['goal']])
        colour = 'yes' if one['success'] else 'no'
        shown.append(f'<figure>{drawn}<figcaption>{html.escape(plan["scene"])}: '
                     f'<span class="{colour}">{one["outcome"]}</span> after '
                     f'{one["decisions"]} decisions, {one["seconds"]} s</figcaption></figure>')
    return f"""<h2>On a base that is late and slips</h2>
<p class="soft">Not of this run: <code>vn_nav drive-trial</code> drove these, {result['date']},
{html.escape(result['machine'])}, in houses that no training saw. The harsh base
{html.escape(trial['about']['harsh'])}</p>
{_compared(result['bases'])}{_difference(result)}
<div class="maps">{''.join(shown)}</div>"""


def _difference(result: dict) -> str:
    if 'success_difference' not in result:
        return ''
    success, low, high = (100 * value for value in result['success_difference'])
    decisions, fewer, more = result['decisions_difference']
    return (f'<p>Harsh minus ideal, on the same starts: success {success:+.0f} points '
            f'({low:+.0f} to {high:+.0f}), decisions {decisions:+.0f} ({fewer:+.0f} to '
            f'{more:+.0f}).</p>')


def _compared(figures: dict[str, dict]) -> str:
    """A line a figure, a column a base."""
    def quantiles(values: list[float] | None, form: str) -> str:
        return '-' if values is None else '{0:{2}}, {1:{2}}'.format(*values, form)
    lines = [
        ('episodes', lambda r: str(r['episodes'])),
        ('success (95 %)', lambda r: '{:.2f} ({:.2f}-{:.2f})'.format(r['success'],
                                                                     *r['success_interval'])),
        ('SPL', lambda r: number(r['spl'], '.2f')),
        ('declared', lambda r: number(r.get('declared'), '.2f')),
        ('false stops', lambda r: number(r.get('false_stops'), '.2f')),
        ('collisions', lambda r: f'{r["collisions"]:.1%}'),
        ('interventions', lambda r: str(r['interventions'])),
        ('distance of stops [m]', lambda r: quantiles(r['good_stop_m'], '.2f')),
        ('heading of stops [deg]', lambda r: quantiles(r['good_stop_deg'], '.0f')),
        ('decisions an episode', lambda r: f'{r["decisions"]:.0f}'),
        ('seconds an episode', lambda r: f'{r["seconds"]:.0f}')]
    return table(['', *figures], [[name, *(shown(own) for own in figures.values())]
                                  for name, shown in lines])


def _scene(drives: dict[str, Drive]) -> str:
    """The journeys of every base over the same floor, and each episode in a table."""
    first = next(iter(drives.values())).scene
    figures = ''.join(
        f'<figure>{_map(drive)}<figcaption>{base}</figcaption></figure>'
        for base, drive in drives.items() if 'bounds' in drive.scene)
    rows = [[html.escape(one.episode.goal), base, _outcome(one.episode),
             f'{one.episode.start_distance:.1f}', f'{one.episode.path_length:.1f}',
             str(one.episode.decisions), str(one.episode.collisions),
             f'{one.episode.seconds:.0f}', f'{one.episode.stop_distance:.2f}',
             f'{math.degrees(one.episode.stop_heading):.0f}']
            for group in zip(*(drive.episodes for drive in drives.values()), strict=True)
            for base, one in zip(drives, group, strict=True)]
    heads = ['goal', 'base', 'outcome', 'start [m]', 'driven [m]', 'decisions', 'collisions',
             'seconds', 'stop [m]', 'stop [deg]']
    return (f'<h3>{html.escape(first.get("scene", ""))}</h3><div class="maps">{figures}</div>'
            f'<details><summary>Episodes</summary>{table(heads, rows, text=3)}</details>')


def _outcome(episode: Episode) -> str:
    kind, words = outcome(episode)
    return f'<span class="{kind}">{words}</span>'


def outcome(episode: Episode) -> tuple[str, str]:
    """The class of its colour, and words."""
    if episode.success:
        return 'yes', 'arrived'
    return 'no', 'false stop' if episode.declared else 'gave up'


def _map(drive: Drive) -> str:
    return floor_map(drive.scene,
                     [Journey(one.trajectory, one.episode.success) for one in drive.episodes],
                     [goal['pose'] for goal in drive.scene['goals']])
