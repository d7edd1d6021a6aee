"""A short visit to the graph by a command: a node, its executor, a context of its own."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from vn_nav.errors import UserError


@contextlib.contextmanager
def visiting(name: str, namespace: str) -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """Join the graph, and leave it.

    Args:
        name: of the node; namespace: of the robot, empty: none.

    Raises:
        UserError: the middleware cannot start.
    """
    context = Context()
    try:
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = Node(name, namespace=namespace or None, context=context,
                    start_parameter_services=False, enable_rosout=False)
    except Exception as error:  # of C code, in many classes
        context.try_shutdown()
        raise UserError('a node can join the graph', ' '.join(str(error).split())[:200],
                        'correct the namespace, RMW_IMPLEMENTATION and ROS_DOMAIN_ID') from error
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
