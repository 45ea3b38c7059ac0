"""The server of the page without a node: who may read and act, and what it bears."""
from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, ExitStack
from http.client import HTTPConnection, HTTPResponse
import json
import math
from pathlib import Path
import socket
import threading
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytest.importorskip('aiohttp', reason='needs aiohttp')
from handeye_ros.node.errors import PageError  # noqa: E402, I100
from handeye_ros.page import server as servers  # noqa: E402
from handeye_ros.page.buttons import Source  # noqa: E402
from handeye_ros.page.contents import plain  # noqa: E402
from handeye_ros.page.guard import BURST, Guard, MOST_CONNECTIONS  # noqa: E402
from handeye_ros.page.server import PageServer  # noqa: E402

pytestmark = pytest.mark.once

JSON = {'Content-Type': 'application/json'}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return int(probe.getsockname()[1])


class Cell:
    """What the buttons do here: they are counted; 'wait' goes on until it is let go."""

    def __init__(self) -> None:
        self.asked: list[Mapping[str, Any]] = []
        self.go_on = threading.Event()

    def take(self, values: Mapping[str, Any]) -> tuple[bool, str]:
        self.asked.append(values)
        return True, 'sample 1 taken'

    def wait(self, values: Mapping[str, Any]) -> tuple[bool, str]:
        self.go_on.wait()
        return True, 'done'


@contextmanager
def served(address: str = '127.0.0.1') -> Iterator[tuple[PageServer, Cell]]:
    cell = Cell()
    source = Source(lambda: {'name': 'plate', 'count': math.nan},
                    {'take': cell.take, 'wait': cell.wait}, frozenset({'wait'}))
    page = PageServer(source, address, free_port())
    try:
        yield page, cell
    finally:
        cell.go_on.set()
        page.stop()


def asked(page: PageServer, method: str, path: str, body: str | bytes | None = None,
          **headers: str) -> tuple[int, str]:
    """Return status and text of an answer; headers: _ for - in their names."""
    connection = HTTPConnection('127.0.0.1', page.guard.port, timeout=30)
    named = {name.replace('_', '-'): value for name, value in headers.items()}
    connection.request(method, path, body, named)
    answer: HTTPResponse = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def test_it_shows_the_page_and_acts() -> None:
    with served() as (page, cell):
        for path, kind in (('/', '<!DOCTYPE html>'), ('/page.css', ':root'),
                           ('/page.js', "'use strict'"), ('/scene.js', "'use strict'")):
            status, text = asked(page, 'GET', path)
            assert status == 200 and text.startswith(kind)
            assert 'http://' not in text and 'https://' not in text, 'no file of another host'
        status, text = asked(page, 'POST', '/act/take', '{"number": 3}', Content_Type=JSON[
            'Content-Type'])
        assert (status, json.loads(text)) == (
            200, {'success': True, 'message': 'sample 1 taken'})
        assert cell.asked == [{'number': 3}]
        assert page.url == f'http://127.0.0.1:{page.guard.port}/'


@pytest.mark.parametrize(('path', 'body', 'status'), [
    ('/act/none', '{}', 404), ('/act/take', '[]', 400), ('/act/take', '{', 400),
    ('/act/take', '[' * 900, 400), ('/act/take', b'\xff', 400),
    ('/act/take', '{"a": "' + 'x' * 2000 + '"}', 413)])
def test_what_is_no_request_is_refused(path: str, body: str | bytes, status: int) -> None:
    with served() as (page, cell):
        assert asked(page, 'POST', path, body, Content_Type='application/json')[0] == status
        assert cell.asked == []


def test_forms_and_other_methods_do_not_act() -> None:
    with served() as (page, cell):
        form = asked(page, 'POST', '/act/take', 'number=3',
                     Content_Type='application/x-www-form-urlencoded')
        assert form[0] == 415
        assert asked(page, 'GET', '/act/take')[0] in (404, 405)
        assert asked(page, 'GET', '/../config.py')[0] == 404
        assert asked(page, 'GET', '/guard.py')[0] == 404
        assert cell.asked == []


@pytest.mark.parametrize('headers', [
    {'Origin': 'http://evil.example'}, {'Origin': 'null'}, {'Host': 'evil.example'},
    {'Host': 'evil.example:80'}, {'Sec_Fetch_Site': 'cross-site'},
    {'Sec_Fetch_Site': 'same-site'}, {'Host': '192.168.0.7'}])
def test_other_origins_are_refused(headers: dict[str, str]) -> None:
    with served() as (page, cell):
        for method, path in (('GET', '/'), ('GET', '/events'), ('POST', '/act/take')):
            status, text = asked(page, method, path, '{}', **headers,
                                 Content_Type='application/json')
            assert status == 403, text
        assert cell.asked == []
        host = f'localhost:{page.guard.port}'
        assert asked(page, 'GET', '/', Host=host, Origin=f'http://{host}')[0] == 200


def test_other_machines_need_the_token() -> None:
    with served('0.0.0.0') as (page, cell):
        assert page.guard.token and page.guard.token not in page.url
        for path in ('/', '/events', '/page.js', '/?token=wrong', '/?token='):
            status, text = asked(page, 'GET', path)
            assert status == 401 and page.guard.token not in text
        assert asked(page, 'POST', '/act/take', '{}', Content_Type='application/json')[0] == 401
        assert cell.asked == []
        assert asked(page, 'GET', f'/?token={page.guard.token}')[0] == 303
        assert 'name="token"' in asked(page, 'GET', '/')[1], 'it asks for the token'
        for cookie in (f'{page.guard.cookie}=\xff', '\xff'):
            assert asked(page, 'GET', '/', Cookie=cookie)[0] == 401
        cookie = f'{page.guard.cookie}={page.guard.token}'
        assert asked(page, 'GET', '/', Cookie=cookie)[0] == 200
        assert asked(page, 'POST', '/act/take', '{}', Cookie=cookie,
                     Content_Type='application/json')[0] == 200
    assert Guard('0.0.0.0', 1).token != Guard('0.0.0.0', 1).token


def test_the_token_survives_a_restart_in_a_file_of_the_user_alone(tmp_path: Path) -> None:
    file = tmp_path / 'new' / 'token'
    token = Guard('0.0.0.0', 1, file).token
    assert file.stat().st_mode & 0o777 == 0o600 and file.read_text().strip() == token
    assert Guard('0.0.0.0', 1, file).token == token
    file.chmod(0o644)  # others may have read it
    assert Guard('0.0.0.0', 1, file).token != token and not file.stat().st_mode & 0o077
    other = tmp_path / 'none'
    assert not Guard('127.0.0.1', 1, other).token and not other.exists()


def test_events_come_as_json() -> None:
    with served() as (page, _), socket.create_connection(('127.0.0.1', page.guard.port)) as line:
        line.sendall(f'GET /events HTTP/1.1\r\nHost: 127.0.0.1:{page.guard.port}\r\n\r\n'.encode())
        with line.makefile('rb') as stream:
            data = next(row for row in stream if row.startswith(b'data: '))
        assert json.loads(data[6:]) == {'name': 'plate', 'count': None}


def test_it_ends_while_somebody_looks() -> None:
    with ExitStack() as opened:
        with served() as (page, _):
            line = opened.enter_context(
                socket.create_connection(('127.0.0.1', page.guard.port), 30))
            line.sendall(f'GET /events HTTP/1.1\r\nHost: 127.0.0.1:{page.guard.port}\r\n\r\n'
                         .encode())
            stream = opened.enter_context(line.makefile('rb'))
            next(row for row in stream if row.startswith(b'data: '))
        assert stream.read().endswith(b'\r\n0\r\n\r\n'), 'the last chunk of a whole answer'


def test_there_is_an_end_to_who_may_look() -> None:
    with served() as (page, _), ExitStack() as lookers:
        for _ in range(servers.MOST_CLIENTS):
            line = lookers.enter_context(socket.create_connection(('127.0.0.1', page.guard.port)))
            line.sendall(f'GET /events HTTP/1.1\r\nHost: 127.0.0.1:{page.guard.port}\r\n\r\n'
                         .encode())
            assert b'200 OK' in line.recv(100)
        status, text = asked(page, 'GET', '/events')
        assert status == 503 and 'browsers look at this page' in text


def test_what_takes_long_keeps_nobody_else_waiting() -> None:
    with served() as (page, cell):
        answers: list[int] = []
        threads = [threading.Thread(target=lambda: answers.append(asked(
            page, 'POST', '/act/wait', '{}', Content_Type='application/json')[0]))
            for _ in range(servers.MOST_WAITING + 3)]
        for thread in threads:
            thread.start()
        while len(answers) < 3:  # those beyond the queue are answered at once
            threads[0].join(0.01)
        assert answers == [429] * 3
        assert asked(page, 'POST', '/act/take', '{}', Content_Type='application/json')[0] == 200
        cell.go_on.set()
        for thread in threads:
            thread.join()
        assert sorted(answers) == [200] * servers.MOST_WAITING + [429] * 3


def test_idle_connections_make_room_for_one_that_asks() -> None:
    with served() as (page, _), ExitStack() as lines:
        others = [lines.enter_context(socket.create_connection(('127.0.0.1', page.guard.port)))
                  for _ in range(MOST_CONNECTIONS)]
        assert asked(page, 'GET', '/')[0] == 200
        others[0].settimeout(30)
        assert others[0].recv(1) == b'', 'the oldest is closed'
        for other in others[1:]:
            other.setblocking(False)
            with pytest.raises(BlockingIOError):  # and these are not
                other.recv(1)


def test_a_request_that_breaks_off_is_no_fault_of_the_node(
        caplog: pytest.LogCaptureFixture) -> None:
    with served() as (page, _):
        with socket.create_connection(('127.0.0.1', page.guard.port)) as line:
            line.sendall(b'POST /act/take HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n'
                         b'Content-Type: application/json\r\n\r\n{')
            assert asked(page, 'GET', '/')[0] == 200  # until then it is being read
        assert asked(page, 'GET', '/')[0] == 200
    assert 'Traceback' not in caplog.text


def test_too_many_requests_are_refused() -> None:
    guard = Guard('127.0.0.1', 80)
    answers = [guard.refusal({'Host': 'localhost'}, '') for _ in range(int(3 * BURST))]
    assert answers[0] is None
    refused = [a.status for a in answers if a]
    assert set(refused) == {429}


def test_refused_requests_keep_nobody_out() -> None:
    guard = Guard('127.0.0.1', 80)
    foreign = {'Host': 'localhost', 'Origin': 'http://other.example'}
    answers = [guard.refusal(foreign, '') for _ in range(int(3 * BURST))]
    assert {a.status for a in answers if a} == {403}
    assert guard.refusal({'Host': 'localhost'}, '') is None


def test_a_port_in_use_and_an_address_that_is_none() -> None:
    with served() as (page, _), pytest.raises(PageError, match='set page.port to another'):
        PageServer(Source(dict, {}), '127.0.0.1', page.guard.port)
    with pytest.raises(PageError, match='expected an IP address'):
        PageServer(Source(dict, {}), 'everywhere', 1)


def test_json_knows_no_nan() -> None:
    assert plain({'a': [math.nan, 1.0, (math.inf, 'b')], 1: None}) == {
        'a': [None, 1.0, [None, 'b']], '1': None}
