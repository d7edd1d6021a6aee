"""A route as a page: its pictures with their numbers, to name places by."""

from __future__ import annotations

import base64
import html
import shlex
from collections.abc import Sequence

from vn_nav.dashboard.pictures import jpeg
from vn_nav.report.page import page
from vn_nav.routes.route import Route

SIDE_PX = 150
STYLE = """<style>.route { display:flex; flex-wrap:wrap; gap:10px } .route figure { margin:0 }
.route img { height:150px; border-radius:6px; display:block } .route .named img {
outline:3px solid var(--goal); outline-offset:-3px } .route figcaption { font-size:.8rem }</style>
"""


def route_page(route: Route, along: Sequence[tuple[float, float]] = ()) -> str:
    """HTML of a route.

    Args:
        route: its pictures are read.
        along: for each picture the time [s] and the way driven [m] until then, if they are known.
    """
    named = {number: name for name, number in route.places.items()}
    figures = []
    for k, number in enumerate(route.numbers):
        data = base64.b64encode(jpeg(route.picture(k)[0], SIDE_PX)).decode()
        name = f'<b>{html.escape(named[number])}</b> ' if number in named else ''
        where = f'<br>{along[k][1]:.1f} m, {along[k][0]:.0f} s' if along else ''
        figures.append(f'<figure{" class=named" if name else ""}><img alt="picture {number}" '
                       f'src="data:image/jpeg;base64,{data}"><figcaption>{name}{number}{where}'
                       '</figcaption></figure>')
    folder = html.escape(shlex.quote(str(route.folder)))
    return page(f'Route {route.folder.name}', f"""{STYLE}
<h1>Route {html.escape(route.folder.name)}</h1>
<p>{len(route)} pictures, in the order in which they were taken. Name places by their numbers, then
drive there:</p>
<pre>vn_nav route {folder} --name kitchen={route.numbers[-1]}
ros2 run vn_nav route_node --ros-args -p route:={folder}
vn_nav goal kitchen</pre>
<div class="route">{''.join(figures)}</div>
""")
