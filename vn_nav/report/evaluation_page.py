"""One self-contained HTML page about an evaluation: figures, controls, scenes, maps."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

import numpy as np

from vn_nav import __version__
from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_nav.evaluation.evaluator import ABSENT, ARRIVAL, BLANK, DECLARED, RANDOM, WRONG, Rows
from vn_nav.evaluation.metrics import HABITAT_RADIUS_M, Episode
from vn_nav.report.maps import MARGIN_M, PIXELS_PER_M, Journey, floor_map
from vn_nav.report.page import cards, page, picture
from vn_nav.report.search_map import Window, draw
from vn_nav.report.tables import SPLITS, TITLES, number, rows_html, scenes_html, unit

MAPS = 6  # of a split, unless the user asks for another number
SEARCH_LEGEND = """<p class="soft">Beside each floor plan is the map that the policy had at the
end, out of its camera and its odometry alone. White is free, dark occupied, grey unknown; thin
lines show what is really there: the map drifts against it as the odometry does. Full arrows are
where it took the goal to be, the likeliest orange, larger with more evidence; the blue outline is
the goal, of which it knows nothing. Green: where the robot really was.</p>"""
DEFINITIONS = f"""<h2>Definitions</h2><dl>
<dt>Arrival</dt><dd>The simulator ends an episode as soon as the robot stands, at the end of a
decision, within {ARRIVAL_RADIUS:g} m of the goal (driving distance) and faces within
{math.degrees(ARRIVAL_HEADING):g} degrees of the picture's
direction. That is success. On a grid it stands in the very cell and faces the very way, and
distances are steps: moves and turns. (Other tasks than pictures of places have rules of their
own.)</dd>
<dt>Declared stop</dt><dd>The robot has to declare arrival. Success needs arrival at that
moment; a false stop ends the episode. <i>Declared</i> and <i>false stops</i> are shares of
episodes; <i>reached</i> is the share in which the robot was at its goal at some time.
<i>Within {HABITAT_RADIUS_M:g} m</i> is success by Habitat's rule: declared within that driving
distance, whatever the heading; in brackets its SPL.</dd>
<dt>SPL</dt><dd>Success weighted by path length: 1 means that every journey succeeded on the
shortest way.</dd>
<dt>Decisions, seconds, return</dt><dd>Means over episodes; time at the robot's default limits;
undiscounted reward.</dd>
<dt>Collisions, contact-free</dt><dd>Share of decisions that touched something; share of episodes
that succeeded without any.</dd>
<dt>Filter acted, filter changed</dt><dd>Share of decisions at which the policy's action filter
offset an action (an action without progress there is blocked, and after much turning driving on is
pushed); share at which another action came out than without it.</dd>
<dt>Stop error</dt><dd>Distance and angle to the goal at the end of all episodes.</dd>
<dt>Odometry</dt><dd>What the policy was told of its own motion. <i>True</i>: what really
happened; <i>drift</i>: that, with the errors of a good indoor base; <i>commanded</i>: the moves as
commanded, cut off at contacts; <i>none</i>: nothing.</dd>
<dt>Wrong goal, blank goal</dt><dd>The same policy on the same starts, but shown the picture of
another goal of the scene, or plain grey; it is still measured at the right place. A policy that
looks at its picture falls far behind here. It may well stop where that other picture was taken:
<i>at the picture</i> is the share in which it did.</dd>
<dt>Absent goal</dt><dd>The same policy, shown the picture of another scene: whatever it declares
is false.</dd>
<dt>Explorer</dt><dd>No policy: a robot that knows true depth and, once its camera shows what the
goal picture shows, the way to the goal; until then it drives to the nearest part that it has not
seen.</dd></dl>"""


def evaluation_page(result: dict, measured: dict[str, Rows],
                    plans: dict[str, dict[str, dict | None]], *, maps: int = MAPS) -> str:
    """The page.

    Args:
        result: as `vn_nav evaluate --json` writes it.
        measured: the episodes behind it, by split.
        plans: floor plans by split and scene; None: there is none, see `floor_map`.
        maps: at most this many of each split.
    """
    body = ''.join(_split(name, split, measured[name], plans[name], result, maps)
                   for name, split in result['splits'].items())
    return page('vn_nav evaluate', f"""<h1>{html.escape(result['checkpoint'])}</h1>
<p class="soft">Simulator {html.escape(str(result['simulator']))}, world version
{html.escape(str(result['world_version']))}, task
{html.escape(result['task'])}, actions by the rule <i>{result['decoding']}</i>, at most
{result['max_decisions']} decisions an episode, seed {result['seed']}, odometry:
{html.escape(result['odometry'])}, ranges: {html.escape(result['ranges'])},
camera: {html.escape(result['camera'])}. vn_nav {__version__},
{result['date']}.</p>
{body}
{DEFINITIONS}""")


def _split(name: str, split: dict, rows: Rows, plans: dict[str, dict | None], result: dict,
           maps: int) -> str:
    # The headline is the declared stop, where the policy can declare one.
    headline = DECLARED if DECLARED in split['rows'] else ARRIVAL
    tables = ''.join(f'<h3>{TITLES[stop]}</h3>{rows_html(own, stop)}'
                     for stop, own in split['rows'].items())
    bag, limit, scenes = result.get('bag'), result['max_decisions'], len(split['scenes'])
    each = ''.join(f'<h3>{TITLES[stop]}</h3>{scenes_html(split["scenes"], stop)}'
                   for stop in split['rows'])
    each = '' if bag else f'<details><summary>By scene</summary>{each}</details>'
    where = f'{scenes} scene{"s" * (scenes > 1)}' if bag is None else (
        f'In the pictures of the drive {html.escape(bag)}')
    own = next(iter(split['rows'][headline].values()))
    chosen = choose(next(iter(rows[headline].values())), maps)
    figures = ''.join(_map(episode, plan, limit, bag) for episode in chosen
                      if (plan := plans[episode.scene]) is not None)
    legend = ('<p class="soft">Dot: start; ring: end; blue arrow: the goal and where its picture '
              'looks; crosses: contacts.</p>' if chosen else '')
    searched = any(episode.search is not None for episode in chosen)
    legend += SEARCH_LEGEND if searched else ''
    return f"""<h2>{html.escape(SPLITS.get(name, name))}</h2>
<p class="soft">{where}, {own['episodes']} episodes a row, mean start
distance {number(own['start_distance'], '.1f')} {unit(own)}.</p>
{_cards(split['rows'][headline], headline)}
{tables}
{each}
{legend}<div class="maps{' searched' if searched else ''}">{figures}</div>"""


def _cards(rows: dict[str, dict], stop: str) -> str:
    own = next(iter(rows.values()))

    def others(key: str, form: str) -> str:
        return '; '.join(f'{name} {number(rows[name][key], form)}'
                         for name in (WRONG, BLANK, RANDOM) if name in rows)
    low, high = own['success_interval']
    entries = [
        (f'{own["success"]:.0%}', f'success, {TITLES[stop].lower()} ({low:.0%} to {high:.0%})',
         others('success', '.0%')),
        (number(own['spl'], '.2f'), 'SPL', others('spl', '.2f')),
        (f'{own["collisions"]:.1%}', 'decisions with a collision',
         f'{own["contact_free_success"]:.0%} succeeded without any'),
        (f'{own["decisions"]:.0f}', 'decisions an episode',
         f'{number(own["seconds"], ".0f")} s of driving'),
    ]
    if stop == DECLARED:
        absent = (f'; {rows[ABSENT]["declared"]:.0%} where the goal is absent'
                  if ABSENT in rows else '')
        entries.insert(1, (f'{own["false_stops"]:.0%}', 'false stops',
                           f'reached the goal in {own["reached"]:.0%}{absent}'))
    return cards(entries)


def choose(episodes: Sequence[Episode], count: int) -> list[Episode]:
    """Episodes to show: half failures, as far as there are any; from many scenes; long ways first.

    Args:
        episodes: to choose from.
        count: how many at most.
    """
    def spread(kind: bool) -> list[Episode]:
        seen: dict[str, int] = {}
        ranked = []
        for e in sorted(episodes, key=lambda e: -np.nan_to_num(e.start_distance)):
            if e.success == kind:
                ranked.append((seen.get(e.scene, 0), e))
                seen[e.scene] = seen.get(e.scene, 0) + 1
        return [e for _, e in sorted(ranked, key=lambda pair: pair[0])]

    good, bad = spread(True), spread(False)
    failures = max(min(len(bad), count // 2), count - len(good))
    return good[:count - failures] + bad[:failures]


def outcome(episode: Episode) -> str:
    """How an episode ended."""
    if episode.declared is None:
        return 'arrived' if episode.success else 'gave up'
    if episode.declared:
        return 'stopped at the goal' if episode.success else 'false stop'
    return 'passed its goal and never stopped' if episode.reached else 'gave up'


def search_map(episode: Episode, plan: dict) -> str:
    """What a policy that searches knew at an episode's end, as an image of a page."""
    assert episode.search is not None and episode.trajectory is not None
    x0, y0, x1, y1 = plan['bounds']
    view = Window.about(plan['bounds'], round((x1 - x0 + 2 * MARGIN_M) * PIXELS_PER_M),
                        round((y1 - y0 + 2 * MARGIN_M) * PIXELS_PER_M))
    drawn = draw(episode.search, view, episode.trajectory[0], plan=plan,
                 track=episode.trajectory, goal=episode.goal_pose)
    return f'<img alt="the map of the policy" src="{picture(drawn)}">'


def _map(episode: Episode, plan: dict, limit: int, bag: str | None) -> str:
    assert episode.trajectory is not None  # of an episode that was driven here
    kind = 'yes' if episode.success else 'no'
    goals = [] if episode.goal_pose is None else [episode.goal_pose]
    drawn = floor_map(plan, [Journey(episode.trajectory, episode.success, episode.contacts)],
                      goals)
    count = episode.decisions
    after = (f'after {count} decision{"s" * (count > 1)}' if count < limit
             else f'at the limit of {limit} decisions')
    to = 'To the' if bag else f'{html.escape(episode.scene)}, to the'
    shortest = ('' if math.isnan(episode.start_distance) else
                f' for a shortest way of {episode.start_distance:.1f} {episode.unit}')
    if episode.search is not None:
        drawn = f'<div>{drawn}{search_map(episode, plan)}</div>'
    return f"""<figure>{drawn}<figcaption>{to}
{html.escape(episode.goal)}: <span class="{kind}">{outcome(episode)}</span> {after},
{episode.path_length:.1f} {episode.unit}{shortest}; end
{episode.stop_distance:.1f} {episode.unit} from the goal</figcaption></figure>"""
