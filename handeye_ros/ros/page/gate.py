"""How many connections the page has at once."""
from __future__ import annotations

import asyncio

from aiohttp import web

MOST_CONNECTIONS = 64


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
