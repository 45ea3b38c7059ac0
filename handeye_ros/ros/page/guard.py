"""
Who may read the page, and act: requests of this host's own pages, or with the token.

Another site's page in the same browser must neither act (its Origin gives it away, and
Sec-Fetch-Site) nor read through a name that it lets point here (its Host does). Where other
machines can reach the page a token is needed too; the first visit puts it into a cookie.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import hmac
import ipaddress
import secrets
import socket
import time

MOST_A_SECOND = 20.0  # requests
BURST = 60.0
TOKEN_BYTES = 18


@dataclass(frozen=True)
class Refusal:
    """Why a request is not answered: its HTTP status and a sentence."""

    status: int
    text: str


class Guard:
    """
    Judges requests.

    token: empty where only this machine can reach the page.
    """

    def __init__(self, address: str, port: int) -> None:
        """Make a new token where one is needed; raises ValueError for an address that is none."""
        self.port = port
        self.local = is_loopback(address)
        self.token = '' if self.local else secrets.token_urlsafe(TOKEN_BYTES)
        self._hosts = {'localhost', address, socket.gethostname()}
        self._left, self._since = BURST, time.monotonic()

    @property
    def cookie(self) -> str:
        """Return the name of the cookie that holds the token; cookies know no ports."""
        return f'handeye_{self.port}'

    def refusal(self, headers: Mapping[str, str], given: str) -> Refusal | None:
        """Return why a request is refused, None where it is not; given: its token."""
        if not self._in_time():
            return Refusal(429, 'too many requests: wait a second')
        host = headers.get('Host', '')
        if not self._is_ours(host):
            return Refusal(403, 'this page is not served under that name')
        origin = headers.get('Origin')
        site = headers.get('Sec-Fetch-Site', 'same-origin')
        if origin not in (None, f'http://{host}') or site not in ('same-origin', 'none'):
            return Refusal(403, 'requests of other pages are refused')
        if self.token and not hmac.compare_digest(given.encode(), self.token.encode()):
            return Refusal(401, 'open the full address, with its token, that the node printed '
                           'at its start')
        return None

    def _is_ours(self, host: str) -> bool:
        name = host.rpartition(':')[0] if host.endswith(f':{self.port}') else host
        name = name.strip('[]')
        if name in self._hosts:
            return True
        try:
            return ipaddress.ip_address(name).is_loopback or not self.local
        except ValueError:
            return False

    def _in_time(self) -> bool:
        """Tell whether a request may come now (token bucket)."""
        now = time.monotonic()
        self._left = min(BURST, self._left + (now - self._since) * MOST_A_SECOND)
        self._since = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach an address; raises ValueError for none."""
    return address == 'localhost' or ipaddress.ip_address(address).is_loopback
