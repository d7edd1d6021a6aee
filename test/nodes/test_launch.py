"""What can be checked of the launch files without `launch`, which no wheel brings."""

import ast

import pytest
from paths import ROOT

FILES = sorted((ROOT / 'launch').glob('*.launch.py'))
ARGUMENTS = {'namespace', 'use_sim_time', 'params_file', 'autostart', 'use_respawn', 'log_level'}


def calls(tree, name):
    """The calls of a function in a file."""
    return [node for node in ast.walk(tree)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
            and node.func.id == name]


def option(call, name):
    """A keyword argument that is a literal."""
    return next(ast.literal_eval(keyword.value) for keyword in call.keywords
                if keyword.arg == name)


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.stem)
def test_launch_file(path):
    tree = ast.parse(path.read_text())
    compile(tree, str(path), 'exec')
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert 'generate_launch_description' in functions
    declared = {ast.literal_eval(call.args[0]) for call in calls(tree, 'DeclareLaunchArgument')}
    assert declared == ARGUMENTS, 'the arguments are those of Nav2, and none is overridden'
    used = {ast.literal_eval(call.args[0]) for call in calls(tree, 'LaunchConfiguration')
            if isinstance(call.args[0], ast.Constant)}
    assert used <= declared, 'an argument is used and not declared'
    for call in calls(tree, 'Node') + calls(tree, 'LifecycleNode'):
        assert option(call, 'package') == 'vn_nav'
        assert f"'{option(call, 'executable')}'" in (ROOT / 'setup.py').read_text()


def test_which_profile_each_file_uses():
    assert [path.name for path in FILES] == ['drive.launch.py', 'sim.launch.py']
    drive, sim = (path.read_text() for path in FILES)
    assert 'fastdds_multihost.xml' in drive and 'fastdds_localhost.xml' not in drive
    assert "'fastdds_localhost.xml'" in sim and 'multihost' not in sim
    assert 'drive.launch.py' in sim


def test_nothing_activates_the_node_behind_an_operators_back():
    """The node configures and activates itself once; no handler of the launch does it later."""
    for path in FILES:
        assert 'TRANSITION_ACTIVATE' not in path.read_text()
        assert 'OnStateTransition' not in path.read_text()


def test_a_parameter_that_two_nodes_share_means_the_same_in_both():
    """In config/policy.yaml the key /**: gives every node the same value."""
    from vn_nav.nodes import policy_parameters
    from vn_sim_bridge import bridge_parameters
    shared = set(policy_parameters.PARAMETERS) & set(bridge_parameters.PARAMETERS)
    assert shared == {'enable_stamped_cmd_vel', 'mode', 'robot', 'seed', 'time'}
