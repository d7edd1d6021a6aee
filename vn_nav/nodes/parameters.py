"""Parameters of all nodes: one table a node, from which they are declared, checked and explained.

A table maps names to (default, meaning), or to (default, meaning, limits). Limits are (least,
most) for numbers, in the parameter's unit, or the allowed values for text; None: none. The type of
the default is the type of the parameter.
"""

from __future__ import annotations

import difflib
import math
import sys
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from vn_nav.errors import UserError

TYPES = {bool: 'true or false', int: 'a whole number', float: 'a number with a point, as in 20.0',
         str: 'text; in quotes where it looks like a number', list: 'a list of texts'}


def declare(node: Node, table: Mapping[str, tuple], *, read_only: bool = False,
            others: Collection[str] | None = ()) -> dict[str, Any]:
    """Declare the parameters of a table on a node; their values by name.

    Args:
        node: the node.
        table: see the module.
        read_only: they are read once: setting one later is refused.
        others: names of other nodes' parameters, which a shared file may hold for this node too;
            None: more is declared afterwards, so that nothing is unknown yet.

    Raises:
        UserError: a value of another type or outside its limits, or an unknown name on the
            command line of this process. Unknown names in files are a warning.
    """
    # What files and the command line say; rclpy has it under no public name.
    given = {name: parameter.value for name, parameter in node._parameter_overrides.items()}
    for name in table:
        if name in given:
            check(name, table, given[name])
    for name, entry in table.items():
        node.declare_parameter(name, entry[0], _descriptor(entry, read_only))
    if others is not None:
        _name_unknown(node, given, others)
    return {name: node.get_parameter(name).value for name in table}


def check(name: str, table: Mapping[str, tuple], value: object) -> None:
    """Raise a `UserError` for a value of another type, not finite or outside its limits."""
    default, limits = table[name][0], _limits(table[name])
    remedy = f'set it with -p {name}:=..., or in the params file'
    if not _fits(value, default):
        raise UserError(f'{name} is {TYPES[type(default)]}', value, remedy)
    if isinstance(value, float) and not math.isfinite(value):
        raise UserError(f'{name} is finite', value, remedy)
    if limits is None:
        return
    if isinstance(default, str):
        if value not in limits:
            raise UserError(f'{name} is one of {_listed(limits)}', value, remedy)
    elif not limits[0] <= value <= limits[1]:
        raise UserError(f'{name} lies between {limits[0]} and {limits[1]}', value, remedy)


def help_lines(table: Mapping[str, tuple]) -> list[str]:
    """A line for each parameter: its name, default, limits and meaning."""
    lines = []
    for name, entry in table.items():
        default, meaning, limits = entry[0], entry[1], _limits(entry)
        shown = _listed(default) if isinstance(default, list) else (
            str(default).lower() if isinstance(default, bool) else default)
        span = ''
        if limits is not None:
            span = f'; {_listed(limits)}' if isinstance(default, str) else (
                f'; {limits[0]} to {limits[1]}')
        lines.append(f'  {name} ({"empty" if shown == "" else shown}{span}): {meaning}')
    return lines


def _limits(entry: tuple) -> Sequence | None:
    return entry[2] if len(entry) > 2 else None


def _listed(values: Sequence[str]) -> str:
    return ', '.join(value or '(empty)' for value in values)


def _fits(value: object, default: object) -> bool:
    """Whether ROS takes a value for a parameter with this default."""
    if isinstance(default, list):  # an empty one has no type of its own
        return isinstance(value, list) and all(isinstance(part, str) for part in value)
    return type(value) is type(default)


def _descriptor(entry: tuple, read_only: bool) -> ParameterDescriptor:
    default, meaning, limits = entry[0], entry[1], _limits(entry)
    descriptor = ParameterDescriptor(description=meaning, read_only=read_only)
    if limits is None:
        return descriptor
    if isinstance(default, str):
        descriptor.additional_constraints = f'one of {_listed(limits)}'
    else:
        kind, slot = ((IntegerRange, descriptor.integer_range) if isinstance(default, int) else
                      (FloatingPointRange, descriptor.floating_point_range))
        slot.append(kind(from_value=limits[0], to_value=limits[1]))
    return descriptor


def _name_unknown(node: Node, given: Collection[str], others: Collection[str]) -> None:
    unknown = sorted(name for name in given if not node.has_parameter(name))
    for name in unknown:
        if any(f':{given}'.partition(':=')[0].endswith(f':{name}') for given in sys.argv[1:]):
            near = difflib.get_close_matches(name, node._parameters, 1)
            raise UserError(f'a parameter is one that {node.get_name()} has', name,
                            f'did you mean {near[0]}?' if near else 'see --help')
    if strange := [name for name in unknown if name not in others]:
        node.get_logger().warning(
            f'{node.get_name()} has no parameter {", ".join(strange)}: what a params file sets '
            'there does nothing; correct the name, or put it under its own node')
