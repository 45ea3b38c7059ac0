"""
Serves the page: static files, a stream of events, and one request for each button.

aiohttp runs in its own thread and event loop. Another thread collects the state, at most RATE
times a second and only while a browser is connected; requests wait in a short queue. So no request
and no slow browser delays the node.
"""
from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib import resources
import json
from pathlib import Path
import threading
from typing import Any

from aiohttp import web
from handeye_ros.errors import HandeyeError
from handeye_ros.node.errors import PageError
from handeye_ros.page.buttons import Served, Source, source
from handeye_ros.page.contents import plain
from handeye_ros.page.guard import Gate, Guard

RATE = 5.0  # events a second, at most
MOST_CLIENTS = 8
MOST_WAITING = 4  # requests of one kind
LARGEST_BODY = 1024  # bytes
COOKIE_AGE = 30 * 86400  # s
PATIENCE = 10.0  # s until a client must accept an event, and the server must start
FILES = ('page.css', 'page.js', 'scene.js', 'profile.js', 'cell.js', 'language.js', 'de.js')
KINDS = {'.html': 'text/html', '.css': 'text/css', '.js': 'text/javascript'}
HEADERS = {
    'Content-Security-Policy': "default-src 'self'; img-src 'self' data:; "
                               "frame-ancestors 'none'; base-uri 'none'",
    'X-Content-Type-Options': 'nosniff', 'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-store'}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def serve(node: Served) -> PageServer | None:
    """Serve the page of a node; None and a warning in the log if it cannot be served."""
    config, log = node.live.config, node.get_logger()
    try:
        token_file = node.live.folders.parent(config) / '.page_token'
        page = PageServer(source(node), config.page.address, config.page.port, token_file)
    except PageError as error:
        log.warning(str(error))
        return None
    log.info(f'page for a browser: {page.url}' + (
        f'; it asks for the token in {token_file}' if page.guard.token else ''))
    return page


class PageServer:
    """The server of a page, from its construction until stop."""

    def __init__(self, source: Source, address: str, port: int,
                 token_file: Path | None = None) -> None:
        """Start to serve; token_file: keeps the token, if one is needed. Raises PageError."""
        try:
            self.guard = Guard(address, port, token_file)
        except ValueError as error:
            raise PageError.address(address) from error
        except OSError as error:
            raise PageError.token(token_file, error.strerror or str(error)) from error
        self._busy: dict[asyncio.BaseTransport, int] = {}  # running requests by connection
        self._source, self._address, self._port = source, address, port
        self._clients = 0
        self._waiting = dict.fromkeys((True, False), 0)
        self._pools = {slow: ThreadPoolExecutor(1, 'page') for slow in (True, False)}
        self._gatherer = ThreadPoolExecutor(1, 'page')
        self._event = ''
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name='page', daemon=True)
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._start(), self._loop).result(PATIENCE)
        except OSError as error:
            self._end_loop()
            raise PageError.port(address, port, error.strerror or str(error)) from error

    @property
    def url(self) -> str:
        """Return the address, without the token."""
        name = f'[{self._address}]' if ':' in self._address else self._address
        return f'http://{name}:{self._port}/'

    async def _start(self) -> None:
        self._changed, self._ending = asyncio.Condition(), False
        app = web.Application(middlewares=[self._guarded], client_max_size=LARGEST_BODY)
        app.router.add_get('/', self._index)
        app.router.add_get('/events', self._events)
        app.router.add_get('/read/{name}', self._read)
        app.router.add_get('/{name}', self._file)
        app.router.add_post('/act/{name}', self._act)
        self._runner = web.AppRunner(app, access_log=None, keepalive_timeout=15.0)
        await self._runner.setup()
        self._server = await self._loop.create_server(self._protocol, self._address, self._port)
        self._gathering = self._loop.create_task(self._gather())

    def _protocol(self) -> asyncio.BaseProtocol:
        """Return the protocol of a new connection."""
        assert self._runner.server is not None
        return Gate(self._runner.server, self._busy)

    def stop(self) -> None:
        """End all connections, and the thread."""
        with suppress(TimeoutError):
            asyncio.run_coroutine_threadsafe(self._stop(), self._loop).result(PATIENCE)
        self._end_loop()

    async def _stop(self) -> None:
        self._ending = True
        self._gathering.cancel()
        self._server.close()
        async with self._changed:  # end the streams of events: cleanup waits for them
            self._changed.notify_all()
        await self._runner.cleanup()

    def _end_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(PATIENCE)
        for pool in (self._gatherer, *self._pools.values()):
            pool.shutdown(wait=False, cancel_futures=True)

    async def _gather(self) -> None:
        """Gather the state while a browser is connected."""
        while True:
            if self._clients:
                self._event = await self._loop.run_in_executor(self._gatherer, self._text)
                async with self._changed:
                    self._changed.notify_all()
            await asyncio.sleep(1 / RATE)

    def _text(self) -> str:
        try:
            return json.dumps(plain(self._source.state()), allow_nan=False)
        except HandeyeError as error:
            return json.dumps({'error': str(error)})

    async def _events(self, request: web.Request) -> web.StreamResponse:
        if self._clients >= MOST_CLIENTS:
            return _sentence(503, f'{MOST_CLIENTS} browsers look at this page: close one')
        response = web.StreamResponse(headers=HEADERS | {'Content-Type': 'text/event-stream'})
        self._clients += 1
        try:
            await response.prepare(request)
            while not self._ending:
                async with self._changed:
                    await self._changed.wait()
                await asyncio.wait_for(response.write(f'data: {self._event}\n\n'.encode()),
                                       PATIENCE)
        except (TimeoutError, ConnectionError):
            pass
        finally:
            self._clients -= 1
        return response

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        token = request.query.get('token') or request.cookies.get(self.guard.cookie, '')
        refusal = self.guard.refusal(request.headers, token)
        if refusal and refusal.status == 401 and request.path in ('/', '/page.css'):
            return _static(*(('login.html', 401) if request.path == '/' else ('page.css', 200)))
        if refusal:
            return _sentence(refusal.status, refusal.text)
        connection = request.transport
        if connection is None:  # closed while the request waited
            return _sentence(400, 'the connection is closed')
        self._busy[connection] = self._busy.get(connection, 0) + 1
        try:
            return await handler(request)
        except web.HTTPException as error:
            return _sentence(error.status, error.reason.lower())
        except ConnectionError:  # closed before the request was complete
            return _sentence(400, 'the connection is closed')
        finally:
            if connection in self._busy:
                self._busy[connection] -= 1

    async def _index(self, request: web.Request) -> web.StreamResponse:
        if 'token' in request.query:
            response = web.Response(status=303, headers=HEADERS | {'Location': '/'})
            response.set_cookie(self.guard.cookie, self.guard.token, httponly=True,
                                samesite='Strict', max_age=COOKIE_AGE)
            return response
        return _static('index.html')

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info['name']
        return _static(name) if name in FILES else _sentence(404, 'there is no such page')

    async def _read(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info['name']
        read = self._source.reads.get(name)
        if read is None:
            return _sentence(404, 'there is no such page')
        try:
            answer = await self._queued(name, read, request.query)
        except (HandeyeError, ValueError) as error:
            return _sentence(404, str(error))
        if isinstance(answer, web.Response):
            return answer
        if isinstance(answer, tuple):
            named = {'Content-Disposition': f'attachment; filename="{answer[0]}"'}
            return web.Response(text=answer[1], headers=HEADERS | named)
        return web.json_response(plain(answer), headers=HEADERS)

    async def _act(self, request: web.Request) -> web.StreamResponse:
        act = self._source.acts.get(request.match_info['name'])
        if act is None:
            return _sentence(404, 'there is no such button')
        if request.content_type != 'application/json':
            return _sentence(415, 'expected application/json')
        values = object_of(await request.read())
        if values is None:
            return _sentence(400, 'expected a JSON object')
        answer = await self._queued(request.match_info['name'], act, values)
        if isinstance(answer, web.Response):
            return answer
        return web.json_response({'success': answer[0], 'message': answer[1]}, headers=HEADERS)

    async def _queued(self, name: str, work: Callable[[Any], Any], values: Any) -> Any:
        """Return work(values), or a refusal if too many requests wait."""
        slow = name in self._source.slow
        if self._waiting[slow] >= MOST_WAITING:
            return _sentence(429, 'busy: wait for the answer to the previous request')
        self._waiting[slow] += 1
        try:
            return await self._loop.run_in_executor(self._pools[slow], work, values)
        finally:
            self._waiting[slow] -= 1


def _sentence(status: int, text: str) -> web.Response:
    return web.json_response({'success': False, 'message': text}, status=status, headers=HEADERS)


def _static(name: str, status: int = 200) -> web.Response:
    text = resources.files(__package__).joinpath('assets', name).read_text(encoding='utf-8')
    kind = KINDS[name[name.rindex('.'):]]
    return web.Response(text=text, status=status, content_type=kind, charset='utf-8',
                        headers=HEADERS)


def object_of(text: bytes) -> dict[str, Any] | None:
    """Return the object of a JSON text, None for other values."""
    try:
        value = json.loads(text or b'{}')
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None
