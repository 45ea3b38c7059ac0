"""
Access to the page: requests of the page itself, and from other machines with the token.

Pages of other sites in the same browser are refused by Origin and Sec-Fetch-Site, and foreign host
names that point to this machine by Host. If other machines can reach the page a token is needed;
the first visit stores it in a cookie. A file that only its user can read keeps it over restarts.
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
MOST_A_SECOND = 20.0  # requests, on average
BURST = 60.0  # requests at once
TOKEN_BYTES = 18


@dataclass(frozen=True)
class Refusal:
    """Why a request is not answered: its HTTP status and a sentence."""

    status: int
    text: str


class Guard:
    """
    Decides which requests are answered.

    token: empty if only this machine can reach the page.
    """

    def __init__(self, address: str, port: int, token_file: Path | None = None) -> None:
        """
        Read the token from its file, or make one, if one is needed.

        Raises ValueError for an invalid address, OSError for a file that cannot be written.
        """
        self.port = port
        self.local = is_loopback(address)
        self.token = '' if self.local else token_of(token_file)
        self._hosts = {'localhost', address, socket.gethostname()}
        self._tokens, self._since = BURST, time.monotonic()

    @property
    def cookie(self) -> str:
        """Return the name of the cookie that holds the token; cookies know no ports."""
        return f'handeye_{self.port}'

    def refusal(self, headers: Mapping[str, str], token: str) -> Refusal | None:
        """Return why a request is refused, None if it is not; token: of the request."""
        host = headers.get('Host', '')
        if not self._is_ours(host):
            return Refusal(403, 'this page is not served under that name')
        origin = headers.get('Origin')
        site = headers.get('Sec-Fetch-Site', 'same-origin')
        if origin not in (None, f'http://{host}') or site not in ('same-origin', 'none'):
            return Refusal(403, 'requests of other pages are refused')
        if self.token and not hmac.compare_digest(token.encode(errors='replace'),
                                                  self.token.encode()):
            return Refusal(401, 'the token is missing or wrong')
        # last: requests that are refused for other reasons do not count
        if not self._take_token():
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

    def _take_token(self) -> bool:
        """Return whether the rate allows a request (token bucket)."""
        time_now = time.monotonic()
        self._tokens = min(BURST, self._tokens + (time_now - self._since) * MOST_A_SECOND)
        self._since = time_now
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True


class Gate(asyncio.Protocol):
    """
    Accepts a new connection; if there are too many, the oldest idle one is closed.

    busy: number of running requests by connection, the oldest first.
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
    """Return the token of a file; write a new one if it holds none."""
    if file is None:
        return secrets.token_urlsafe(TOKEN_BYTES)
    with suppress(OSError, UnicodeDecodeError):
        token = file.read_text(encoding='ascii').strip()
        if len(token) >= TOKEN_BYTES and not file.stat().st_mode & 0o077:
            return token
    token = secrets.token_urlsafe(TOKEN_BYTES)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.unlink(missing_ok=True)
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), 'w') as stream:
        stream.write(token + '\n')
    return token


def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach an address; raises ValueError."""
    return address == 'localhost' or ipaddress.ip_address(address).is_loopback
