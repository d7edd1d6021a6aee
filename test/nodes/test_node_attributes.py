"""Our nodes keep nothing under a name that rclpy's Node uses for itself."""

import ast
import importlib
import inspect
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BASES = {'Node': 'rclpy.node', 'LifecycleNode': 'rclpy.lifecycle.node'}
pytestmark = pytest.mark.ros


def assigned(tree):
    """Names of the attributes that some code gives to `self`."""
    return {part.attr for part in ast.walk(tree) if isinstance(part, ast.Attribute)
            and isinstance(part.ctx, ast.Store) and isinstance(part.value, ast.Name)
            and part.value.id == 'self'}


def node_classes():
    for folder in ('vn_nav', 'vn_sim_bridge', 'examples'):
        for file in sorted((ROOT / folder).rglob('*.py')):
            for part in ast.walk(ast.parse(file.read_text())):
                if isinstance(part, ast.ClassDef):
                    bases = {base.id for base in part.bases if isinstance(base, ast.Name)}
                    for base in bases & set(BASES):
                        yield part, base


def test_no_attribute_of_a_node_hides_one_of_rclpy():
    found = list(node_classes())
    assert {'SimBridgeNode', 'PolicyNode'} <= {part.name for part, _ in found}
    for part, base in found:
        taken = set()
        for kind in getattr(importlib.import_module(BASES[base]), base).__mro__[:-1]:
            taken |= assigned(ast.parse(inspect.getsource(inspect.getmodule(kind)))) | set(
                vars(kind))
        assert '_clock' in taken
        assert not assigned(part) & taken, part.name
