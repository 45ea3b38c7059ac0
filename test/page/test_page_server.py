# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The server of the page without a node: who may read and act, and what it bears."""
from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, ExitStack
from dataclasses import replace
from http.client import HTTPConnection
import json
import math
from pathlib import Path
import socket
from tempfile import TemporaryDirectory
import threading
from types import SimpleNamespace
from typing import Any

from command import free_port
from handeye_ros.bags.session_files import files_of
from handeye_ros.errors import HandeyeError, InputError
from live_sessions import fed, new, PARTS, SPHERE
import pytest

pytest.importorskip('aiohttp', reason='needs aiohttp')
from handeye_ros.page import server as servers  # noqa: E402, I100
from handeye_ros.page.contents import page_source, PageSource  # noqa: E402
from handeye_ros.page.server import PageServer, read_or_write_token  # noqa: E402

pytestmark = pytest.mark.once

PIECES = {  # of each file that it serves
    '': '<!DOCTYPE html>', 'page.css': ':root {', 'page.js': 'new EventSource(',
    'viewer.js': 'function turnable(', 'scene.js': 'function drawScene(',
    'profile.js': 'function drawProfile(', 'setup.js': 'function readSetup(',
    'shared.js': 'function ask('}
KIND = {'Content_Type': 'application/json'}


class Buttons:
    """What buttons do here: they are counted; 'wait' goes on until it is let go."""

    def __init__(self) -> None:
        self.asked: list[Mapping[str, Any]] = []
        self.go_on = threading.Event()

    def take(self, values: Mapping[str, Any]) -> tuple[bool, str]:
        self.asked.append(values)
        return True, 'sample 1 taken'

    def wait(self, values: Mapping[str, Any]) -> tuple[bool, str]:
        self.go_on.wait()
        raise HandeyeError('never mind')


@contextmanager
def served(address: str = '127.0.0.1', state: Any = lambda: {'name': 'plate', 'count': math.nan}
           ) -> Iterator[tuple[PageServer, Buttons]]:
    buttons = Buttons()
    source = PageSource(state, {
        'take': buttons.take, 'wait': buttons.wait, 'break': lambda _: 1 / 0}, {})
    with TemporaryDirectory() as folder:
        try:
            yield PageServer(source, address, free_port(), Path(folder) / 'token'), buttons
        finally:
            buttons.go_on.set()


@pytest.fixture(scope='module')
def server() -> Iterator[tuple[PageServer, Buttons]]:
    """Give one server on this machine to all tests that change nothing of it."""
    with served() as page_and_buttons:
        yield page_and_buttons


def asked(page: PageServer, method: str, path: str, body: str | bytes | None = None,
          **headers: str) -> tuple[int, str]:
    """Return status and text of an answer; headers: _ for - in their names."""
    connection = HTTPConnection('127.0.0.1', page.port, timeout=30)
    connection.request(method, path, body, {k.replace('_', '-'): v for k, v in headers.items()})
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def connected(page: PageServer, lines: ExitStack, request: str, body: bytes = b'') -> Any:
    """Return a line on which a request was sent."""
    line = lines.enter_context(socket.create_connection(('127.0.0.1', page.port), 30))
    line.sendall(f'{request} HTTP/1.1\r\nHost: localhost:{page.port}\r\n'.encode() + body)
    return line


def test_it_shows_the_page_and_acts(server: tuple[PageServer, Buttons]) -> None:
    page, buttons = server
    assert PIECES.keys() == {'', *servers.ASSET_FILES}
    for name, piece in PIECES.items():
        status, text = asked(page, 'GET', f'/{name}')
        assert status == 200 and piece in text
        assert 'http://' not in text and 'https://' not in text, 'no file of another host'
    status, text = asked(page, 'POST', '/act/take', '{"number": 3}', **KIND)
    assert (status, json.loads(text)) == (200, {'success': True, 'message': 'sample 1 taken'})
    assert buttons.asked.pop() == {'number': 3}


@pytest.mark.parametrize(('method', 'path', 'body', 'headers', 'status'), [
    ('POST', '/act/none', '{}', KIND, 404),
    ('POST', '/act/take', '[]', KIND, 400),
    ('POST', '/act/take', '[' * 900, KIND, 400),
    ('POST', '/act/take', b'\xff', KIND, 400),
    ('POST', '/act/take', '{"a": "' + 'x' * 2000 + '"}', KIND, 413),
    ('POST', '/act/take', 'number=3', {'Content_Type': 'application/x-www-form-urlencoded'}, 415),
    ('POST', '/act/take', b'{}', KIND | {'Content_Encoding': 'gzip'}, 400),
    ('GET', '/../config.py', None, {}, 404),
    ('GET', '/server.py', None, {}, 404),
    ('GET', '/read/none', None, {}, 404),
    *((method, path, '{}', KIND | headers, 403)
      for method, path in (('GET', '/'), ('GET', '/events'), ('POST', '/act/take'))
      for headers in ({'Origin': 'http://evil.example'}, {'Origin': 'null'},
                      {'Host': 'evil.example:80'}, {'Sec_Fetch_Site': 'cross-site'},
                      {'Host': '192.168.0.7'}, {'Host': 'cell.local'}, {'Host': '[::1'},
                      {'Host': '[a]b'}, {'Host': 'a@localhost'}))])
def test_what_is_no_request_or_of_another_origin_is_refused(
        server, method, path, body, headers, status):
    page, buttons = server
    assert asked(page, method, path, body, **headers)[0] == status
    assert buttons.asked == []


def test_what_is_no_http_is_refused_without_a_traceback(server, caplog):
    with ExitStack() as lines:
        for request in ('hello', 'GET /', 'GET /' + 9000 * 'x'):
            line = connected(server[0], lines, request, b'Host: twice\r\n\r\n')
            assert line.recv(100).split()[1] == b'400'
    assert not caplog.text


def test_it_tells_what_failed_and_goes_on(capfd: pytest.CaptureFixture[str]) -> None:
    states = iter([ZeroDivisionError, ValueError])

    def state() -> Mapping[str, Any]:
        raise next(states, HandeyeError)('of the state')

    with served(state=state) as (page, _), ExitStack() as lines:
        line = connected(page, lines, 'GET /events', b'\r\n')
        text = b''
        while b'"error": "of the state"' not in text:
            text += line.recv(4096)
        assert b"ZeroDivisionError('of the state'); the log shows where" in text
        status, text = asked(page, 'POST', '/act/break', '{}', **KIND)
        assert status == 500 and json.loads(text) == {'success': False, 'message': (
            "this failed: ZeroDivisionError('division by zero'); the log shows where")}
    assert capfd.readouterr().err.count('Traceback') == 3


def test_other_machines_need_the_token() -> None:
    with served('0.0.0.0') as (page, buttons):
        assert page.token and page.token not in page.url
        assert page.url == f'http://{socket.gethostname()}:{page.port}/'
        for path in ('/', '/events', '/page.js', '/?token=wrong', '/?token='):
            status, text = asked(page, 'GET', path)
            assert status == 401 and page.token not in text
        assert asked(page, 'POST', '/act/take', '{}', **KIND)[0] == 401
        assert buttons.asked == []
        assert asked(page, 'GET', f'/?token={page.token}')[0] == 303
        for path, is_wrong in (('/', False), ('/?token=', False), ('/?token=wrong', True)):
            form = asked(page, 'GET', path)[1]
            assert 'name="token"' in form, 'it asks for the token'
            assert ('<p>This is a wrong token.</p>' in form) == is_wrong
        assert asked(page, 'GET', '/', Cookie=f'{page.cookie}=\xff')[0] == 401
        cookie = f'{page.cookie}={page.token}'
        for host in ('localhost:9000', f'cell.local:{page.port}', '192.168.0.7', '[::1]:1'):
            assert asked(page, 'GET', '/', Cookie=cookie, Host=host)[0] == 200
        assert asked(page, 'GET', '/', Host='cell.example')[0] == 401, 'no other site has it'
        assert asked(page, 'POST', '/act/take', '{}', Cookie=cookie, **KIND)[0] == 200


def test_the_token_survives_a_restart_in_a_file_of_the_user_alone(tmp_path: Path) -> None:
    file = tmp_path / 'new' / 'token'
    token = read_or_write_token(file)
    assert file.stat().st_mode & 0o777 == 0o600 and file.read_text().strip() == token
    assert read_or_write_token(file) == token != read_or_write_token(tmp_path / 'other')
    file.chmod(0o644)  # others may have read it
    assert read_or_write_token(file) != token and not file.stat().st_mode & 0o077


def test_events_come_as_json(server: tuple[PageServer, Buttons]) -> None:
    with ExitStack() as lines:
        line = connected(server[0], lines, 'GET /events', b'\r\n')
        stream = lines.enter_context(line.makefile('rb'))
        data = next(row for row in stream if row.startswith(b'data: '))
        assert json.loads(data[6:]) == {'name': 'plate', 'count': None}


def test_what_takes_long_or_never_ends_keeps_nobody_else_waiting(caplog):
    head = b'Content-Length: 9\r\nContent-Type: application/json\r\n\r\n{'
    with served() as (page, buttons), ExitStack() as lines:
        answers: list[tuple[int, str]] = []
        threads = [threading.Thread(target=lambda: answers.append(
            asked(page, 'POST', '/act/wait', '{}', **KIND))) for _ in range(4)]
        for thread in threads:
            thread.start()
        waiting = [connected(page, lines, 'POST /act/take', head) for _ in range(80)]
        assert asked(page, 'POST', '/act/take', '{}', **KIND)[0] == 200
        waiting[-1].close()  # one breaks off
        assert asked(page, 'POST', '/act/take', '{}', **KIND)[0] == 200
        assert len(buttons.asked) == 2
        assert waiting[0].recv(100).startswith(b'HTTP/1.1 408 ')  # within some seconds
        buttons.go_on.set()
        for thread in threads:
            thread.join()
        assert [(status, json.loads(text)) for status, text in answers] == [
            (200, {'success': False, 'message': 'never mind'})] * 4
    assert 'Traceback' not in caplog.text


def test_a_port_in_use_and_an_address_that_is_none(server: tuple[PageServer, Buttons]) -> None:
    with pytest.raises(InputError, match='set page.port to another'):
        PageServer(PageSource(dict, {}, {}), '127.0.0.1', server[0].port, Path())
    with pytest.raises(InputError, match='expected an IP address'):
        PageServer(PageSource(dict, {}, {}), 'everywhere', 1, Path())


def test_a_damaged_session_hides_no_setting_and_no_other_session(tmp_path: Path) -> None:
    config = replace(SPHERE.config, output_dir=str(tmp_path))
    folder = Path(fed(config, PARTS[0]).path)
    file = files_of(folder)[1]
    file.write_bytes(file.read_bytes()[:1000])
    node = SimpleNamespace(live=new(config), streams=SimpleNamespace(topics_of=lambda kind: []))
    setup = page_source(node).queries['setup']({})
    assert (setup['sessions'], setup['previous']) == ([folder.name], 0) and setup['settings']
