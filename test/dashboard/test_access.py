"""Who may use the dashboard."""

import pytest

from vn_nav.dashboard.access import access, is_loopback, same_origin
from vn_nav.errors import UserError


def test_this_machine_needs_no_token_and_others_always_do():
    for host in ('127.0.0.1', '::1', 'localhost', '127.8.8.8'):
        assert is_loopback(host) and access(host, '').token == ''
    drawn = {access(host, '').token for host in ('0.0.0.0', '::', '192.168.1.7', 'robot')}
    assert len(drawn) == 4 and min(map(len, drawn)) > 20
    assert access('127.0.0.1', 'correct horse').token == 'correct horse'


def test_a_token_is_the_right_one_or_none():
    own = access('0.0.0.0', 'correct horse')
    assert own.allows('correct horse')
    assert not any(own.allows(shown) for shown in (None, '', 'correct', 'correct horsf', 'ä'))
    assert access('127.0.0.1', '').allows(None)
    for short in ('short', 'tab\tin the middle', 'größer als acht'):
        with pytest.raises(UserError, match='token'):
            access('127.0.0.1', short)


def test_a_name_that_somebody_points_at_this_machine_is_not_known():
    local = access('127.0.0.1', '')
    assert all(local.knows_host(name) for name in ('127.0.0.1:8080', 'localhost', '[::1]:8080'))
    assert not any(local.knows_host(name) for name in ('evil.example:8080', '', None, '10.0.0.1'))
    assert access('0.0.0.0', '').knows_host('robot.local:8080'), 'a token is shown there'


def test_another_page_is_known_by_its_origin():
    assert same_origin(None, '127.0.0.1:8080'), 'a tool'
    assert same_origin('http://127.0.0.1:8080', '127.0.0.1:8080')
    for other in ('http://evil.example', 'http://127.0.0.1:8081', 'null'):
        assert not same_origin(other, '127.0.0.1:8080')
