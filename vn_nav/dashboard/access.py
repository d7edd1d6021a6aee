"""Who may use the dashboard: this machine alone, or whoever has the token.

A page of another site may make a browser send requests here (cross-site request forgery), also
under a name that it points at 127.0.0.1 (DNS rebinding): both are refused, by `Origin` and `Host`.
"""

from __future__ import annotations

import dataclasses
import hmac
import ipaddress
import secrets
from urllib.parse import urlsplit

from vn_nav.errors import UserError

COOKIE = 'vn_nav_token'
LEAST_TOKEN = 8  # characters


@dataclasses.dataclass(frozen=True)
class Access:
    """The rule.

    Args:
        host: that the server binds.
        token: that others show; '': nobody has to, on this machine.
    """

    host: str
    token: str

    def allows(self, shown: str | None) -> bool:
        """Whether a token, or none, is the right one."""
        return not self.token or hmac.compare_digest((shown or '').encode(), self.token.encode())

    def knows_host(self, header: str | None) -> bool:
        """Whether a request was meant for this server, by its `Host`.

        With a token any name is right: another site does not have it.
        """
        return bool(self.token) or is_loopback(urlsplit(f'//{header or ""}').hostname or '')


def access(host: str, token: str) -> Access:
    """The rule for a server: without a token on this machine alone.

    Raises:
        UserError: a token that is too short.
    """
    if token and (len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable()):
        raise UserError(f'a token has at least {LEAST_TOKEN} printable ASCII characters',
                        f'{len(token)} characters', 'choose another, or leave it out: one is '
                        'drawn where it is needed')
    return Access(host, token or ('' if is_loopback(host) else secrets.token_urlsafe(16)))


def is_loopback(host: str) -> bool:
    """Whether a host is this machine's own, whoever asks."""
    try:
        return host == 'localhost' or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def same_origin(origin: str | None, host: str | None) -> bool:
    """Whether a request comes from a page of this server; tools send no origin."""
    return origin is None or urlsplit(origin).netloc == (host or '')
