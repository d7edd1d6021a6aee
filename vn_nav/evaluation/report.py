"""One self-contained HTML page about a recorded drive: figures, maps, film strips."""

from __future__ import annotations

import base64
import html
import math
from pathlib import Path

import cv2
import numpy as np

from vn_nav import __version__
from vn_nav.evaluation.bag_episodes import Drive, RecordedEpisode
from vn_nav.evaluation.metrics import path_efficiency

SCALE = 46  # pixels per metre of the maps
STRIP = 9  # pictures of a film strip
TITLES = {'trained': 'The house it was trained in', 'unseen': 'A house it has never seen'}

STYLE = """
:root { --ink:#1d2430; --soft:#5c6675; --line:#d9dee6; --paper:#fbfbf9; --card:#fff;
  --good:#11805a; --bad:#c4572c; --wall:#39424f; --wood:#e6ddcd; --floor:#f4f2ec; --goal:#2a62c9 }
@media (prefers-color-scheme: dark) { :root { --ink:#e8ebf0; --soft:#9aa4b3; --line:#39414e;
  --paper:#14181f; --card:#1b2029; --good:#46c394; --bad:#f08a5d; --wall:#aab4c2; --wood:#3d3a33;
  --floor:#222832; --goal:#7da7f7 } }
* { box-sizing:border-box } body { margin:0; background:var(--paper); color:var(--ink);
  font:16px/1.55 system-ui, sans-serif } main { max-width:1080px;
  margin:0 auto; padding:48px 24px }
h1 { font-size:2.1rem; line-height:1.2; margin:0 0 .3em; letter-spacing:-.02em }
h2 { margin:2.4em 0 .2em; font-size:1.45rem; letter-spacing:-.01em } p { max-width:68ch }
.soft, small, figcaption { color:var(--soft) } .cards { display:flex; gap:14px; flex-wrap:wrap;
  margin:18px 0 } .card { background:var(--card); border:1px solid var(--line); border-radius:12px;
  padding:14px 18px; min-width:150px; flex:1 } .card b { display:block; font-size:1.9rem;
  letter-spacing:-.02em } .card span { font-size:.85rem; color:var(--soft); display:block }
figure { margin:18px 0 } svg { width:100%; height:auto; max-height:640px; background:var(--card);
  border:1px solid var(--line); border-radius:12px } svg text { font:12px system-ui, sans-serif;
  fill:var(--soft) } .strip { display:flex; gap:6px; overflow-x:auto; align-items:flex-end;
  padding:4px 0 } .strip figure { margin:0; flex:none; text-align:center }
.strip img { width:96px; height:96px; image-rendering:pixelated; border-radius:6px; display:block }
.strip .goal img { outline:3px solid var(--goal); outline-offset:-3px } .strip figcaption {
  font-size:.72rem } .journey { border-top:1px solid var(--line); padding:12px 0 }
.journey h3 { margin:0 0 6px; font-size:1rem } .yes { color:var(--good) } .no { color:var(--bad) }
table { border-collapse:collapse; font-size:.9rem; width:100%; font-variant-numeric:tabular-nums }
th, td { text-align:right; padding:5px 10px; border-bottom:1px solid var(--line) }
th:nth-child(2), td:nth-child(2), th:nth-child(3), td:nth-child(3) { text-align:left }
summary { cursor:pointer; margin:14px 0 6px } dt { font-weight:600 } dd { margin:0 0 8px }
"""


def write_report(path: Path, drives: list[Drive], result: dict) -> None:
    """Write the page.

    Args:
        path: of the HTML file.
        drives: trained house, unseen house; with pictures.
        result: the figures, as in result.json.
    """
    places = [(place, drive) for place, drive in zip(('trained', 'unseen'), drives, strict=True)]
    body = ''.join(_place(place, drive, result[place]) for place, drive in places)
    page = f"""<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width,initial-scale=1"><title>vn_nav demo</title>
<style>{STYLE}</style></head><body><main>
<h1>Show a robot a picture, and it drives there</h1>
<p class="soft">Every figure on this page was counted from the ROS 2 bag of one run: simulator and
policy were two processes that met on ROS topics alone. The policy saw the camera, the goal picture
and its own last action; no map, no pose, no depth.</p>
{body}
<h2>What the words mean</h2><dl>
<dt>Success</dt><dd>At the end of a decision the robot stands within 0.6 m of the place (driving
distance) and faces within 30 degrees of the picture's direction. In brackets the 95 %
interval.</dd>
<dt>SPL</dt><dd>Success weighted by path length: 1 means that every journey succeeded on the
shortest way.</dd>
<dt>Collisions</dt><dd>Share of decisions that touched something. The robot does not slide along
walls: a touch ends the movement.</dd>
<dt>Random</dt><dd>Uniform random actions from the same starts to the same goals. Without this
line a success rate says little.</dd></dl>
<p class="soft">vn_nav {__version__}, checkpoint {html.escape(str(result['checkpoint']))},
{result['date']}, {result['seconds']:.0f} s.</p></main></body></html>"""
    path.write_text(page)


def _place(place: str, drive: Drive, figures: dict) -> str:
    control = figures['random']
    low, high = figures['success_interval']
    cards = (
        (f'{figures["success"]:.0%}', f'success ({low:.0%} to {high:.0%})',
         f'random {control["success"]:.0%}'),
        (f'{figures["spl"]:.2f}', 'SPL', f'random {control["spl"]:.2f}'),
        (f'{figures["collisions"]:.1%}', 'decisions with a collision',
         f'random {control["collisions"]:.1%}'),
        (f'{figures["decisions"]:.0f}', 'decisions an episode',
         f'at most {figures["max_decisions"]}; random {control["decisions"]:.0f}'),
    )
    boxes = ''.join(f'<div class="card"><b>{value}</b>{label}<span>{note}</span></div>'
                    for value, label, note in cards)
    scene = drive.scene
    rows = ''.join(_row(recorded) for recorded in drive.episodes)
    journeys = ''.join(_journey(recorded) for recorded in _chosen(drive.episodes))
    limit = '' if place == 'trained' else (
        f' Episodes end at {figures["max_decisions"]} decisions here.')
    return f"""<h2>{TITLES[place]}</h2>
<p class="soft">House {scene['house']}: {len(scene['rooms_list'])} rooms, {scene['area']:.0f}
m&sup2;, {figures['episodes']} episodes, mean start distance
{figures['start_distance']:.1f} m.{limit}</p>
<div class="cards">{boxes}</div>
<figure>{_map(drive)}<figcaption>Dots are starts, arrows are goals with their viewing direction;
<span class="yes">green</span> journeys arrived, <span class="no">orange</span> ones did
not.</figcaption></figure>
{journeys}
<details><summary>All {len(drive.episodes)} episodes</summary><table><tr><th>#</th><th>goal</th>
<th>outcome</th><th>start [m]</th><th>driven [m]</th><th>SPL</th><th>decisions</th>
<th>collisions</th><th>stop [m]</th><th>stop [deg]</th></tr>{rows}</table></details>"""


def _row(recorded: RecordedEpisode) -> str:
    e = recorded.episode
    kind, words = ('yes', 'arrived') if e.success else ('no', 'gave up')
    outcome = f'<span class="{kind}">{words}</span>'
    return (f'<tr><td>{recorded.facts["episode"] + 1}</td><td>{html.escape(e.goal)}</td>'
            f'<td>{outcome}</td><td>{e.start_distance:.1f}</td><td>{e.path_length:.1f}</td>'
            f'<td>{path_efficiency(e):.2f}</td><td>{e.decisions}</td><td>{e.collisions}</td>'
            f'<td>{e.stop_distance:.2f}</td><td>{math.degrees(e.stop_heading):.0f}</td></tr>')


def _chosen(episodes: list[RecordedEpisode], most: int = 4) -> list[RecordedEpisode]:
    """The longest successful journeys, and one that failed: nothing is hidden."""
    with_pictures = [e for e in episodes if e.goal_picture is not None and e.pictures]
    good = sorted((e for e in with_pictures if e.episode.success),
                  key=lambda e: -e.episode.start_distance)
    bad = [e for e in with_pictures if not e.episode.success]
    return good[:most - min(1, len(bad))] + bad[:1]


def _journey(recorded: RecordedEpisode) -> str:
    e = recorded.episode
    # Pictures taken while the robot stood still repeat themselves.
    views = [view for before, view in zip([None, *recorded.pictures], recorded.pictures,
                                          strict=False)
             if before is None or not np.array_equal(before, view)]
    picked = np.unique(np.linspace(0, len(views) - 1, STRIP).round().astype(int))
    frames = ''.join(f'<figure><img alt="" src="{_picture(views[i])}">'
                     f'<figcaption>{i}</figcaption></figure>' for i in picked)
    kind, words = ('yes', 'arrived') if e.success else ('no', 'gave up')
    return f"""<div class="journey"><h3>To the {html.escape(e.goal)}:
<span class="{kind}">{words}</span> <small>after {e.decisions} decisions, {e.path_length:.1f} m
for a shortest way of {e.start_distance:.1f} m</small></h3><div class="strip">
<figure class="goal"><img alt="goal picture" src="{_picture(recorded.goal_picture)}">
<figcaption>goal picture</figcaption></figure>{frames}</div></div>"""


def _picture(rgb: np.ndarray) -> str:
    data = cv2.imencode('.png', cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()
    return 'data:image/png;base64,' + base64.b64encode(data).decode()


def _map(drive: Drive) -> str:
    """Top-down SVG, y upwards."""
    scene = drive.scene
    x0, y0, x1, y1 = scene['bounds']
    margin = 0.3
    width, height = (x1 - x0 + 2 * margin) * SCALE, (y1 - y0 + 2 * margin) * SCALE

    def place(x, y):
        return (x - x0 + margin) * SCALE, height - (y - y0 + margin) * SCALE

    def rect(box, style):
        left, top = place(box[0], box[3])
        return (f'<rect x="{left:.1f}" y="{top:.1f}" width="{(box[2] - box[0]) * SCALE:.1f}" '
                f'height="{(box[3] - box[1]) * SCALE:.1f}" {style}/>')

    parts = [rect(scene['bounds'], 'fill="var(--floor)"')]
    parts += [rect(box, 'fill="var(--card)"') for box in scene.get('outside', [])]
    parts += [rect(box, 'fill="var(--wood)" rx="3"') for *box, _ in scene['obstacles']]
    parts += [rect(box, 'fill="var(--wall)"') for box in scene['walls']]
    for room in scene['rooms_list']:
        left, top = place(room['rect'][0], room['rect'][3])
        parts.append(f'<text x="{left + 8:.1f}" y="{top + 18:.1f}">'
                     f'{html.escape(room["name"])}</text>')
    for recorded in drive.episodes:
        if not len(recorded.trajectory):
            continue
        # Standing still adds no points to the line.
        moved = np.hypot(*np.diff(recorded.trajectory[:, :2], axis=0, prepend=np.inf).T) > 0.02
        points = ' '.join(f'{px:.1f},{py:.1f}' for px, py in
                          (place(x, y) for x, y, _ in recorded.trajectory[moved]))
        colour = 'var(--good)' if recorded.episode.success else 'var(--bad)'
        sx, sy = place(*recorded.trajectory[0, :2])
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" '
                     f'stroke-width="2" stroke-opacity=".6" stroke-linejoin="round"/>'
                     f'<circle cx="{sx:.1f}" cy="{sy:.1f}" r="4" fill="{colour}"/>')
    for goal in scene['goals']:
        x, y, yaw, _ = goal['pose']
        tip = place(x + 0.45 * math.cos(yaw), y + 0.45 * math.sin(yaw))
        base = place(x, y)
        side = [place(x + 0.13 * math.cos(yaw + s), y + 0.13 * math.sin(yaw + s))
                for s in (math.pi / 2, -math.pi / 2)]
        points = ' '.join(f'{px:.1f},{py:.1f}' for px, py in (tip, side[0], side[1]))
        parts.append(f'<polygon points="{points}" fill="var(--goal)"/><circle cx="{base[0]:.1f}" '
                     f'cy="{base[1]:.1f}" r="{0.13 * SCALE:.1f}" fill="var(--goal)"/>')
    return (f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
            f'aria-label="map with journeys">{"".join(parts)}</svg>')
