# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Serves the page: static files, a stream of events, and one request for each button.

aiohttp runs in its own thread and event loop, and what the node is asked runs in a pool of others:
no request and no slow browser delays the node. The state is collected at most EVENT_RATE times a
second, and only while a browser is connected.

Pages of other sites in the same browser are refused by Origin and Sec-Fetch-Site. A page for this
machine alone asks for no token, and refuses foreign host names that point to this machine by Host.
Others ask for the token: the first visit stores it in a cookie, and a file that only its user can
read keeps it over restarts.
"""
from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
import hmac
from importlib import resources
import ipaddress
import json
import logging
from pathlib import Path
import re
import secrets
import socket
import threading
import time
from typing import Any, TYPE_CHECKING
from urllib.parse import quote

from aiohttp import web
from handeye_ros.errors import BadValueError, HandeyeError, InputError, sentence_and_log
from handeye_ros.output import write_errors_for
from handeye_ros.page.contents import Action, page_source, PageSource, Query

if TYPE_CHECKING:
    from handeye_ros.node.node import HandeyeNode

EVENT_RATE = 5.0  # events a second, at most
WORKER_COUNT = 8  # requests that wait for the node at the same time
MAX_BODY_BYTES = 1024
CLIENT_TIMEOUT = 10.0  # s until a client must accept an event
BODY_TIMEOUT = 5.0  # s until the body of a request must be there
COOKIE_AGE = 30 * 86400  # s
TOKEN_BYTES = 18
ASSET_FILES = ('page.css', 'page.js', 'shared.js', 'viewer.js', 'scene.js', 'profile.js',
               'setup.js')
HEADERS = {
    'Content-Security-Policy': "default-src 'self'; img-src 'self' data:; "
                               "frame-ancestors 'none'; base-uri 'none'",
    'X-Content-Type-Options': 'nosniff', 'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-store'}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def serve(node: HandeyeNode) -> None:
    """Serve the page of a node, or log a warning that it cannot be served."""
    config, log = node.live.config, node.get_logger()
    try:
        token_file = node.live.folders.root(config) / '.page_token'
        page = PageServer(page_source(node), config.page.address, config.page.port, token_file)
    except InputError as error:
        log.warning(f'there is no page: {error}')
        return
    log.info(f'page for a browser: {page.url}' + (
        f'; it asks for the token in {token_file}' if page.token else ''))


class PageServer:
    """
    Serves a page until the process ends.

    token: what a browser must know, '' where none is needed
    cookie: the name of the cookie that holds the token
    """

    def __init__(self, source: PageSource, address: str, port: int, token_file: Path) -> None:
        """Start to serve; token_file: keeps the token, if one is needed. Raises InputError."""
        try:
            local = address == 'localhost' or ipaddress.ip_address(address).is_loopback
        except ValueError as error:
            raise BadValueError('page.address', address, 'an IP address such as 127.0.0.1 or '
                                '0.0.0.0') from error
        self.token = '' if local else read_or_write_token(token_file)
        self.port, self._address, self._source = port, address, source
        self.cookie = f'handeye_{port}'  # cookies know no ports
        self._pool = ThreadPoolExecutor(WORKER_COUNT, 'page')
        self._event, self._collected = '', 0.0  # the last event, and when it was collected (s)
        try:
            listening = socket.create_server(
                (address, port), family=socket.AF_INET6 if ':' in address else socket.AF_INET)
        except OSError as error:
            raise InputError(f'{address}:{port} cannot be served ({error.strerror or error}); set '
                             'page.port to another one, or to 0 for no page') from error
        # _guarded tells what handlers raise; left is a traceback for bytes that are no HTTP
        logging.getLogger('aiohttp.server').setLevel(logging.CRITICAL)
        run = partial(web.run_app, self._app(), sock=listening, print=None, access_log=None,
                      handle_signals=False)
        threading.Thread(target=run, name='page', daemon=True).start()

    @property
    def url(self) -> str:
        """Return an address that a browser can open, without the token."""
        everywhere = self._address in ('0.0.0.0', '::')  # which no browser can open
        name = socket.gethostname() if everywhere else self._address
        return f'http://{f"[{name}]" if ":" in name else name}:{self.port}/'

    def _app(self) -> web.Application:
        """Return the application with all routes: page, events, assets, queries and actions."""
        app = web.Application(middlewares=[self._guarded], client_max_size=MAX_BODY_BYTES)
        app.on_response_prepare.append(_add_headers)
        app.router.add_get('/', self._index)
        app.router.add_get('/events', self._events)
        for file in ASSET_FILES:
            app.router.add_get(f'/{file}', partial(_asset, file))
        for name, query in self._source.queries.items():
            app.router.add_get(f'/read/{name}', partial(self._answer_query, query))
        for name, action in self._source.actions.items():
            app.router.add_post(f'/act/{name}', partial(self._run_action, action))
        return app

    async def _call_node(self, function: Callable[[Any], Any], values: Mapping[str, Any]) -> Any:
        """Return what a function of the node returns, which may take long."""
        return await asyncio.get_running_loop().run_in_executor(self._pool, function, values)

    async def _current_event(self) -> str:
        """Return the state as JSON, collected for all browsers at once."""
        if time.monotonic() - self._collected >= 1 / EVENT_RATE:
            self._collected = time.monotonic()
            try:  # in another pool: not behind requests that take long
                self._event = json_text(await asyncio.to_thread(self._source.state))
            except Exception as error:  # noqa: BLE001 - the page must go on
                self._event = json_text({'error': sentence_and_log('this', error)})
        return self._event

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer a request that may be answered; every refusal is a sentence."""
        host, origin = request.headers.get('Host', ''), request.headers.get('Origin')
        site = request.headers.get('Sec-Fetch-Site', 'same-origin')
        token = request.query.get('token', '').strip() or request.cookies.get(self.cookie, '')
        try:
            name = re.sub(r':\d*$', '', host).strip('[]').lower()  # without the port
            if not self.token and name not in (
                    'localhost', '127.0.0.1', '::1', self._address, socket.gethostname().lower()):
                return _sentence(403, 'this page is served for its own machine alone, as '
                                 f'{self.url}')
            if origin not in (None, f'http://{host}') or site not in ('same-origin', 'none'):
                return _sentence(403, 'requests of other pages are refused')
            if self.token and not hmac.compare_digest(token.encode(errors='replace'),
                                                      self.token.encode()):
                if request.path == '/':
                    return _login(is_wrong=bool(request.query.get('token', '').strip()))
                if request.path == '/page.css':
                    return await _asset('page.css')
                return _sentence(401, 'the token is missing or wrong')
            return await handler(request)
        except web.HTTPException as error:
            return _sentence(error.status, error.reason.lower())
        except HandeyeError as error:
            return _sentence(404 if request.method == 'GET' else 200, str(error))
        except ConnectionError:  # closed before the request was complete
            return _sentence(400, 'the connection is closed')
        except Exception as error:  # noqa: BLE001 - whoever asks wants to know
            return _sentence(500, sentence_and_log('this', error))

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """Answer with server-sent events, the state as JSON each, until the client is gone."""
        response = web.StreamResponse(headers={'Content-Type': 'text/event-stream'})
        with suppress(TimeoutError, ConnectionError):
            await response.prepare(request)
            while True:
                if event := await self._current_event():
                    await asyncio.wait_for(response.write(f'data: {event}\n\n'.encode()),
                                           CLIENT_TIMEOUT)
                await asyncio.sleep(1 / EVENT_RATE)
        return response

    async def _index(self, request: web.Request) -> web.StreamResponse:
        """Answer with the page; where the URL has the token, set the cookie and redirect."""
        if 'token' not in request.query:
            return await _asset('index.html')
        response = web.Response(status=303, headers={'Location': '/'})
        response.set_cookie(self.cookie, self.token, httponly=True, samesite='Strict',
                            max_age=COOKIE_AGE)
        return response

    async def _answer_query(self, query: Query, request: web.Request) -> web.StreamResponse:
        """Answer a GET with what a query returns: JSON, or (name, text) as a file to download."""
        answer = await self._call_node(query, request.query)
        if isinstance(answer, tuple):
            return web.Response(text=answer[1], headers={
                'Content-Disposition': f"attachment; filename*=UTF-8''{quote(answer[0])}"})
        return web.json_response(text=json_text(answer))

    async def _run_action(self, action: Action, request: web.Request) -> web.StreamResponse:
        """
        Answer a POST: run a button with the JSON object of its body.

        The answer holds success and message.
        """
        if request.content_type != 'application/json':
            return _sentence(415, 'expected application/json')
        try:
            values = json.loads(await asyncio.wait_for(request.read(), BODY_TIMEOUT) or b'{}')
        except TimeoutError:
            return _sentence(408, 'the request was not complete in time')
        except (ValueError, RecursionError, web.RequestPayloadError):
            values = None
        if not isinstance(values, dict):
            return _sentence(400, 'expected a JSON object')
        success, message = await self._call_node(action, values)
        return web.json_response({'success': success, 'message': message})


async def _add_headers(_: web.Request, response: web.StreamResponse) -> None:
    """Add HEADERS to a response."""
    response.headers.update(HEADERS)


def _sentence(status: int, text: str) -> web.Response:
    """Return the JSON response of a request that is refused, with the reason as message."""
    return web.json_response({'success': False, 'message': text}, status=status)


def json_text(values: Any) -> str:
    """Return values as JSON, with null for infinities and NaN, which JSON lacks."""
    return json.dumps(json.loads(json.dumps(values), parse_constant=lambda _: None))


async def _asset(name: str, _: web.Request | None = None) -> web.StreamResponse:
    """Return the response with an asset of the page, or of the results that it shares."""
    return web.FileResponse(_asset_file(name))


def _asset_file(name: str) -> Path:
    room = 'handeye_ros.results' if name in ('viewer.js', 'profile.js') else 'handeye_ros.page'
    return Path(str(resources.files(room))) / 'assets' / name


def _login(is_wrong: bool) -> web.Response:
    """Return the form that asks for the token; is_wrong: whether it says that one was wrong."""
    form = _asset_file('login.html').read_text(encoding='utf-8')
    return web.Response(text=form.replace('<p hidden>', '<p>') if is_wrong else form, status=401,
                        content_type='text/html')


def read_or_write_token(file: Path) -> str:
    """Return the token of a file; write a new one if it holds none. Raises UnwritableError."""
    with suppress(OSError, UnicodeDecodeError):
        token = file.read_text(encoding='ascii').strip()
        if len(token) >= TOKEN_BYTES and not file.stat().st_mode & 0o077:
            return token
    token = secrets.token_urlsafe(TOKEN_BYTES)
    with write_errors_for(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
        file.touch(mode=0o600, exist_ok=False)
        file.write_text(token + '\n', encoding='ascii')
    return token
