"""Small ProcTHOR houses for tests: two rooms, a door, a window, some objects."""


def point(x, y, z):
    return {'x': x, 'y': y, 'z': z}


def wall(room, name, x0, z0, x1, z1, height=2.5, **more):
    return {'id': f'wall|{room}|{name}', 'roomId': f'room|{room}',
            'polygon': [point(x0, 0, z0), point(x1, 0, z1), point(x1, height, z1),
                        point(x0, height, z0)],
            'material': {'name': 'PureWhite', 'color': {'r': .8, 'g': .9, 'b': .8}}, **more}


def room(number, kind, x0, x1, z0=0.0, z1=4.0):
    return {'id': f'room|{number}', 'roomType': kind, 'floorMaterial': {'name': 'WoodFloor'},
            'floorPolygon': [point(x0, 0, z0), point(x0, 0, z1), point(x1, 0, z1),
                             point(x1, 0, z0)]}


def thing(kind, number, x, y, z, turn=0.0, **more):
    return {'id': f'{kind}|{number}', 'assetId': f'{kind}_{number}', 'position': point(x, y, z),
            'rotation': point(0, turn, 0), **more}


def small_house(**changes):
    """A kitchen (x 0 to 4) and a bedroom (x 4 to 8), 4 m deep; a door between them at z = 1.

    The bed stands in the far corner of the bedroom, turned by 90 degrees.
    """
    house = {
        'rooms': [room(2, 'Kitchen', 0, 4), room(3, 'Bedroom', 4, 8)],
        'walls': [
            wall(2, 'south', 0, 0, 4, 0), wall(2, 'west', 0, 4, 0, 0),
            wall(2, 'north', 4, 4, 0, 4), wall(2, 'east', 4, 0, 4, 4),
            wall(3, 'west', 4, 4, 4, 0), wall(3, 'south', 4, 0, 8, 0),
            wall(3, 'east', 8, 0, 8, 4), wall(3, 'north', 8, 4, 4, 4)],
        'doors': [{'id': 'door|2|3', 'assetId': 'Doorway_1', 'room0': 'room|2', 'room1': 'room|3',
                   'wall0': 'wall|2|east', 'wall1': 'wall|3|west', 'openable': True,
                   'openness': 0, 'holePolygon': [point(.5, 0, 0), point(1.5, 2.1, 0)]}],
        'windows': [{'id': 'window|3', 'wall0': 'wall|3|east', 'wall1': None,
                     'holePolygon': [point(2.0, 1.0, 0), point(3.0, 2.0, 0)]}],
        'objects': [
            thing('Bed', 1, 7, .4, 3, 90), thing('Toaster', 1, 1, .9, 3.5),
            thing('DiningTable', 1, 2, .4, 2.5, children=[thing('Mug', 1, 2, .85, 2.5)])],
        'proceduralParameters': {}, 'metadata': {'schema': '1.0.0'}}
    return {**house, **changes}
