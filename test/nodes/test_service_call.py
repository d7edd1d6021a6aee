"""A call whose answer is lost is made again."""

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from ros_harness import wait_until
from std_srvs.srv import SetBool

from vn_nav.nodes.service_call import ServiceCall

pytestmark = pytest.mark.ros


@pytest.fixture
def executor():
    rclpy.init()
    executor = SingleThreadedExecutor()
    executor.add_node(rclpy.create_node('asks'))
    yield executor
    executor.get_nodes()[0].destroy_node()
    rclpy.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize('lost', [0, 1, 2])
def test_an_answer_that_is_lost_is_asked_for_again(executor, lost):
    node, heard = executor.get_nodes()[0], []

    async def answer(request, response):
        heard.append(request.data)
        if len(heard) <= lost:
            await Future()  # never: the client hears nothing
        response.message = f'answer {len(heard)}'
        return response
    # A callback that never ends holds up all others of its group.
    node.create_service(SetBool, 'enable', answer, callback_group=ReentrantCallbackGroup())
    client = node.create_client(SetBool, 'enable')

    def spin():
        executor.spin_once(timeout_sec=0.01)
    wait_until(client.service_is_ready, spin)
    call = ServiceCall(client, SetBool.Request(data=True), again=1.0)
    wait_until(call.is_answered, spin)
    assert call.asked == len(heard) == lost + 1
    assert call.answer.message == f'answer {lost + 1}'
