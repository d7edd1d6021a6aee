"""`vn_nav route`: a remembered route out of a recorded drive, and names of its places."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from vn_nav.errors import UserError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav route`."""
    from vn_nav.routes.from_bag import EVERY_DEG, EVERY_M
    parser.description = ('Take pictures along a recorded drive as a route, to be driven along by '
                          '`ros2 run vn_nav route_node`; or name places of a route, also of a '
                          'topomap of ViNT or NoMaD. Writes FOLDER/route.html to look at it.')
    parser.add_argument('source', type=Path, metavar='BAG|FOLDER', help='a recorded drive, or a '
                        'route')
    parser.add_argument('--out', type=Path, metavar='FOLDER', help='of the route, out of a bag')
    parser.add_argument('--name', action='append', default=[], metavar='PLACE=NUMBER',
                        help='a name for a picture: its number, first or last; several times')
    parser.add_argument('--every', type=float, default=EVERY_M, metavar='M',
                        help=f'driven between two pictures; default: {EVERY_M}')
    parser.add_argument('--turn', type=float, default=EVERY_DEG, metavar='DEG',
                        help=f'turned between two, if less was driven; default: {EVERY_DEG:g}')
    parser.add_argument('--topics', type=Path, metavar='YAML',
                        help='names of the topics in the bag')


def run(args: argparse.Namespace) -> int:
    """`vn_nav route`."""
    from vn_nav.bags.roles import Topics, load_topics
    from vn_nav.files import write_file
    from vn_nav.report.route_page import route_page
    from vn_nav.routes.from_bag import write_route
    from vn_nav.routes.route import is_route, read_route, with_places
    names = _names(args.name)
    along: list[tuple[float, float]] = []
    if is_route(args.source):
        if args.out is not None:
            raise UserError('--out is for the route of a bag', f'{args.source} is a route',
                            'leave it out')
        route = read_route(args.source)
    else:
        if args.out is None:
            raise UserError('the route of a bag gets a folder', f'no --out for {args.source}',
                            'give --out FOLDER')
        for option, value in (('--every', args.every), ('--turn', args.turn)):
            if not (math.isfinite(value) and value > 0):
                raise UserError(f'{option} is positive', value, 'give another one')
        topics = load_topics(args.topics) if args.topics else Topics()
        route, along = write_route(args.source, args.out, topics, args.every, args.turn)
    page = route.folder / 'route.html'
    if not args.name or along:  # also where a name turns out to be none
        write_file(page, route_page(route, along).encode())
    if names:
        route = with_places(route, names)
        write_file(page, route_page(route, along).encode())
    way = f' along {along[-1][1]:.1f} m, {along[-1][0]:.0f} s' if along else ''
    print(f'{route.folder}: {len(route)} pictures{way}; places: {route.named()}')
    print(f'look at it: {page}')
    if not route.places:
        print(f'name places: vn_nav route {route.folder} --name kitchen={route.numbers[-1]}')
    return 0


def _names(texts: list[str]) -> dict[str, str]:
    found = {}
    for text in texts:
        name, equals, number = text.rpartition('=')
        if not equals or not name or not number:
            raise UserError('--name takes PLACE=NUMBER', text, 'as in kitchen=12 or desk=last')
        found[name] = number
    return found
