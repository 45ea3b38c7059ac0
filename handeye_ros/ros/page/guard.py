"""
Who may read the page, and act: requests of this host's own pages, or with the token.

Another site's page in the same browser must neither act (its Origin gives it away, and
Sec-Fetch-Site) nor read through a name that it lets point here (its Host does). Where other
machines can reach the page a token is needed too; the first visit puts it into a cookie. The
token is kept in a file that its user alone can read, and survives a restart.
"""
from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
import hmac
import ipaddress
import os
from pathlib import Path
import secrets
import socket
import time

from aiohttp import web

MOST_CONNECTIONS = 64
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

    def __init__(self, address: str, port: int, token_file: Path | None = None) -> None:
        """
        Take the token of a file, or make a new one, where one is needed.

        Raises ValueError for an address that is none, OSError for a file that cannot be written.
        """
        self.port = port
        self.local = is_loopback(address)
        self.token = '' if self.local else token_of(token_file)
        self._hosts = {'localhost', address, socket.gethostname()}
        self._left, self._since = BURST, time.monotonic()

    @property
    def cookie(self) -> str:
        """Return the name of the cookie that holds the token; cookies know no ports."""
        return f'handeye_{self.port}'

    def refusal(self, headers: Mapping[str, str], given: str) -> Refusal | None:
        """Return why a request is refused, None where it is not; given: its token."""
        host = headers.get('Host', '')
        if not self._is_ours(host):
            return Refusal(403, 'this page is not served under that name')
        origin = headers.get('Origin')
        site = headers.get('Sec-Fetch-Site', 'same-origin')
        if origin not in (None, f'http://{host}') or site not in ('same-origin', 'none'):
            return Refusal(403, 'requests of other pages are refused')
        if self.token and not hmac.compare_digest(given.encode(errors='replace'),
                                                  self.token.encode()):
            return Refusal(401, 'the token is missing or wrong')
        # refused requests come first: they must not count against those that may come
        if not self._in_time():
            return Refusal(429, 'too many requests: wait a second')
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


class Gate(asyncio.Protocol):
    """
    Lets a new connection in; where there are too many, the oldest that asks for nothing goes.

    busy: how many requests each connection has at work, in the order in which they came.
    """

    def __init__(self, server: web.Server, busy: dict[asyncio.BaseTransport, int]) -> None:
        self._server, self._busy = server, busy

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        for old in [t for t in self._busy if t.is_closing()]:
            del self._busy[old]
        if len(self._busy) >= MOST_CONNECTIONS:
            idle = next((t for t, requests in self._busy.items() if not requests), None)
            if idle is None:
                transport.close()
                return
            del self._busy[idle]
            idle.close()
        self._busy[transport] = 0
        protocol = self._server()
        transport.set_protocol(protocol)
        protocol.connection_made(transport)


def token_of(file: Path | None) -> str:
    """Return the token in a file, a new one that is written into it where there is none."""
    if file is None:
        return secrets.token_urlsafe(TOKEN_BYTES)
    with suppress(OSError, UnicodeDecodeError):
        known = file.read_text(encoding='ascii').strip()
        if len(known) >= TOKEN_BYTES and not file.stat().st_mode & 0o077:
            return known
    token = secrets.token_urlsafe(TOKEN_BYTES)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.unlink(missing_ok=True)
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), 'w') as stream:
        stream.write(token + '\n')
    return token


def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach an address; raises ValueError for none."""
    return address == 'localhost' or ipaddress.ip_address(address).is_loopback
