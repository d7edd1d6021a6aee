"""Houses in SUNCG's format keep the contract of simulators."""

import functools
import tempfile

import pytest
from conformance import ROBOT, SIZE, Conformance

from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator
from vn_sim_bridge.suncg.export import export_suncg


@functools.cache
def data():
    """A folder with two small houses; it goes when the tests end."""
    folder = tempfile.TemporaryDirectory()
    for seed, rooms in ((7, 2), (3, 1)):
        export_suncg(generate_house(seed, rooms=rooms), folder.name)
    return folder


@pytest.mark.slow
class TestSuncg(Conformance):
    def make(self, num_envs, size=SIZE):
        return open_simulator([f'suncg:{name}?data={data().name}' for name in (
            'house_7_2', 'house_3_1')], Setup(num_envs, ROBOT, size))
