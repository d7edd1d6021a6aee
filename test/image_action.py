"""A client of the action navigate_to_image: sends goals one after the other, prints JSON.

`python image_action.py '[{"max_decisions": 2}, {"path": "kitchen.jpg"}, {"cancel_after": 3}]'`. A
goal without a path has a picture. It runs where vn_interfaces is built, see `interface_build`.
"""

import json
import math
import sys
import time

import rclpy
from rclpy.action import ActionClient
from sensor_msgs.msg import Image
from vn_interfaces.action import NavigateToImage

NAME = 'navigate_to_image'
PATIENCE = 100.0  # s; a loaded machine
SIDE = 84


def send(node, client, wanted):
    """Send a goal and wait for its result."""
    heard = []
    goal = NavigateToImage.Goal(path=wanted.get('path', ''),
                                max_decisions=wanted.get('max_decisions', 0))
    if not goal.path:
        goal.image = Image(height=SIDE, width=SIDE, step=3 * SIDE, encoding='rgb8',
                           data=bytes(range(252)) * SIDE)

    def wait(future):
        rclpy.spin_until_future_complete(node, future, timeout_sec=PATIENCE)
        assert future.done(), f'no answer within {PATIENCE} s'
        return future.result()

    handle = wait(client.send_goal_async(
        goal, feedback_callback=lambda message: heard.append(message.feedback)))
    if not handle.accepted:
        return {'accepted': False}
    future, other = handle.get_result_async(), None
    if 'interrupted_by' in wanted:
        until(node, wanted['after'])
        other = send(node, client, wanted['interrupted_by'])
    if 'cancel_after' in wanted:
        until(node, wanted['cancel_after'])
        wait(handle.cancel_goal_async())
    answer = wait(future)
    result = answer.result
    return {'accepted': True, 'status': answer.status, 'code': result.error_code,
            'message': result.error_msg, 'decisions': result.decisions,
            'arrival': None if math.isnan(result.arrival) else result.arrival,
            'seconds': result.navigation_time.sec + 1e-9 * result.navigation_time.nanosec,
            'states': list(dict.fromkeys(each.state for each in heard)),
            'other': other,
            'distance_known': any(not math.isnan(each.distance_remaining) for each in heard)}


def until(node, seconds):
    """Spin for a while."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.05)


def main():
    rclpy.init()
    node = rclpy.create_node('image_client')
    action = ActionClient(node, NavigateToImage, NAME)
    assert action.wait_for_server(PATIENCE), 'no server'
    print(json.dumps([send(node, action, wanted) for wanted in json.loads(sys.argv[1])]))


if __name__ == '__main__':
    main()
