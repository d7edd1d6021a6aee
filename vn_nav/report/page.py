"""What all our HTML pages share: colours for light and dark, style, frame; no other file."""

from __future__ import annotations

import base64
import html

import cv2
import numpy as np

# Names of colours in pages and charts. c0 to c7 distinguish curves, also without red and green.
LIGHT = {
    'ink': '#1d2430', 'soft': '#5c6675', 'line': '#d9dee6', 'paper': '#fbfbf9', 'card': '#ffffff',
    'good': '#11805a', 'bad': '#c4572c', 'wall': '#39424f', 'wood': '#e6ddcd', 'floor': '#f4f2ec',
    'goal': '#2a62c9', 'c0': '#2a62c9', 'c1': '#c4572c', 'c2': '#11805a', 'c3': '#8a4fb8',
    'c4': '#b0812a', 'c5': '#0f8fa3', 'c6': '#c23f77', 'c7': '#5c6675',
}
DARK = {
    'ink': '#e8ebf0', 'soft': '#9aa4b3', 'line': '#39414e', 'paper': '#14181f', 'card': '#1b2029',
    'good': '#46c394', 'bad': '#f08a5d', 'wall': '#aab4c2', 'wood': '#3d3a33', 'floor': '#222832',
    'goal': '#7da7f7', 'c0': '#7da7f7', 'c1': '#f08a5d', 'c2': '#46c394', 'c3': '#c398ea',
    'c4': '#e0b457', 'c5': '#4ecadd', 'c6': '#f283ae', 'c7': '#9aa4b3',
}
CURVES = 8  # colours c0 to c7


def _variables(colours: dict[str, str]) -> str:
    return ':root { ' + '; '.join(f'--{name}:{value}' for name, value in colours.items()) + ' }'


COLOURS = (f'{_variables(LIGHT)}\n'
           f'@media (prefers-color-scheme: dark) {{ {_variables(DARK)} }}\n')
STYLE = COLOURS + """
* { box-sizing:border-box } body { margin:0; background:var(--paper); color:var(--ink);
  font:16px/1.55 system-ui, sans-serif } main { max-width:1140px;
  margin:0 auto; padding:48px 24px }
h1 { font-size:2.1rem; line-height:1.2; margin:0 0 .3em; letter-spacing:-.02em }
h2 { margin:2.4em 0 .2em; font-size:1.45rem; letter-spacing:-.01em } p { max-width:68ch }
h3 { margin:1.8em 0 .4em; font-size:1.05rem }
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
  font-size:.72rem } .strip.grown img { width:252px; height:auto; image-rendering:auto }
.journey { border-top:1px solid var(--line); padding:12px 0 }
.journey h3 { margin:0 0 6px; font-size:1rem } .yes { color:var(--good) } .no { color:var(--bad) }
.maps { display:grid; grid-template-columns:repeat(auto-fill, minmax(310px, 1fr)); gap:16px }
.maps figure { margin:0 } .maps figcaption { font-size:.85rem; padding:4px 2px }
.maps svg text { font-size:20px } .maps.searched { grid-template-columns:1fr }
.searched figure > div { display:grid; grid-template-columns:1fr 1fr; gap:12px }
.searched img { width:100%; border-radius:4px }
.wide { overflow-x:auto }
table { border-collapse:collapse; font-size:.9rem; width:100%; font-variant-numeric:tabular-nums }
th, td { text-align:right; padding:5px 8px; border-bottom:1px solid var(--line);
  vertical-align:bottom } th { font-weight:600 } .wide td { white-space:nowrap }
.wide table { font-size:.85rem } .wide th, .wide td { padding:5px 6px }
.text { text-align:left } tr.first td { font-weight:600 }
summary { cursor:pointer; margin:14px 0 6px } dt { font-weight:600 } dd { margin:0 0 8px }
"""


def page(title: str, body: str) -> str:
    """A whole HTML page.

    Args:
        title: plain text.
        body: HTML.
    """
    return f"""<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width,initial-scale=1">
<meta name="color-scheme" content="light dark"><title>{html.escape(title)}</title>
<style>{STYLE}</style></head><body><main>
{body}</main></body></html>"""


def table(headings: list[str], rows: list[list[str]], *, text: int = 1,
          first: bool = False) -> str:
    """An HTML table.

    Args:
        headings: plain text.
        rows: HTML of the cells.
        text: so many first columns hold text, the others numbers.
        first: whether the first row is the one that matters most.
    """
    def cells(tag: str, row: list[str]) -> str:
        return ''.join(f'<{tag}{" class=text" if k < text else ""}>{cell}</{tag}>'
                       for k, cell in enumerate(row))

    lines = [f'<tr>{cells("th", [html.escape(name) for name in headings])}</tr>']
    lines += [f'<tr{" class=first" if first and k == 0 else ""}>{cells("td", row)}</tr>'
              for k, row in enumerate(rows)]
    return f'<div class="wide"><table>{"".join(lines)}</table></div>'


def cards(entries: list[tuple[str, str, str]]) -> str:
    """Large figures side by side: value, what it is, a note; HTML."""
    boxes = ''.join(f'<div class="card"><b>{value}</b>{label}<span>{note}</span></div>'
                    for value, label, note in entries)
    return f'<div class="cards">{boxes}</div>'


def picture(rgb: np.ndarray) -> str:
    """A picture, [H,W,3] uint8, as the address of an `img`."""
    data = cv2.imencode('.png', cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()
    return 'data:image/png;base64,' + base64.b64encode(data).decode()
