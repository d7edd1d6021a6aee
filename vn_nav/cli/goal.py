"""`vn_nav goal`: drive to a place of a remembered route, by its name."""

from __future__ import annotations

import argparse
import math

from vn_nav.errors import UserError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav goal`."""
    parser.description = ('Tell a running route_node where to drive, and wait until it is there. '
                          'Exit code 0: it is there, 1: it is not, 2: bad usage, 130: Ctrl-C, '
                          'which stops the robot.')
    parser.add_argument('place', nargs='?', metavar='PLACE',
                        help='name, or number of a picture; left out: list the places')
    parser.add_argument('--no-wait', action='store_true', help='say it, and end')
    parser.add_argument('--namespace', default='', metavar='/NS', help='of the robot')
    parser.add_argument('--patience', type=float, default=15.0, metavar='S',
                        help='for a route_node to be found; default: 15')


def run(args: argparse.Namespace) -> int:
    """`vn_nav goal`."""
    if not (math.isfinite(args.patience) and args.patience > 0):
        raise UserError('--patience is positive', args.patience, 'give some seconds')
    if args.place is not None and not args.place.strip():
        raise UserError('a place has a name', repr(args.place), '`vn_nav goal` lists them')
    try:
        from vn_nav.nodes.route_client import RouteClient
    except ModuleNotFoundError as error:
        raise UserError('a robot is told on ROS 2 where to drive', str(error),
                        'source /opt/ros/jazzy/setup.bash') from error
    with RouteClient(args.namespace, args.patience) as client:
        status = client.status()
        places = ', '.join(status['places']) or 'none has a name; numbers of pictures do'
        if args.place is None:
            print(f'places: {places}')
            return 0
        try:
            client.drive_to(args.place)
            return 0 if args.no_wait else _wait(client, args.place)
        except KeyboardInterrupt:
            client.stop()
            print('stopped')
            return 130


def _wait(client, place: str) -> int:
    shown: tuple = ()
    begun = False
    while True:
        status = client.next_status()
        begun = begun or status['status'] in ('locating', 'failed')
        if not begun:
            continue  # the way before
        now = status['shown'], status['here']
        if status['status'] == 'succeeded':
            print(f'arrived at {place}')
            return 0
        if status['status'] not in ('locating', 'active'):
            print(f'{status["status"]}: {status["error_msg"] or "no reason was given"}')
            return 1
        if now != shown and status['shown'] is not None:
            here = 'somewhere' if status['here'] is None else f'near picture {status["here"]}'
            print(f'{here}, drives to picture {status["shown"]}', flush=True)
        shown = now
