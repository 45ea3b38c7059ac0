"""The messages of a .db3 file of rosbag2, one after the other, as far as they can be read."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
import shutil
import sqlite3
import tempfile
import weakref

from handeye_ros.ros.bags.blocks import Block, Gathered
from handeye_ros.ros.bags.contents import Contents, full_name, message_of, type_of


class SqliteFile:
    """
    Reads one database.

    In the order of recording: by time, a bag of two runs would look like one. SQLite refuses
    a file that is cut off, and rightly: what lies behind the cut would be read as zeros.
    """

    def __init__(self, path: Path, name: str, contents: Contents, wanted: set[str] | None
                 ) -> None:
        """name: for the warnings; wanted: the topics whose messages are given, None: all."""
        self._name = name
        self._contents = contents
        self._wanted = wanted
        self._path = self._with_its_log(path)

    def _with_its_log(self, path: Path) -> Path:
        """
        Return a database that holds what a recorder that was killed left in its write-ahead log.

        SQLite would put it into the file itself, but a recording is not ours to change.
        """
        log = path.with_name(f'{path.name}-wal')
        if not (log.exists() and log.stat().st_size):
            return path
        folder = tempfile.TemporaryDirectory(prefix='handeye-')
        weakref.finalize(self, folder.cleanup)  # until then messages may be asked for again
        copy = Path(folder.name) / path.name
        for file in (path, log):
            shutil.copyfile(file, copy.with_name(file.name))
        with suppress(sqlite3.DatabaseError), closing(sqlite3.connect(copy)) as connection:
            connection.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        return copy

    def pieces(self) -> Iterator[list[Block]]:
        """Yield the messages in the order of recording: pieces with a block for each topic."""
        count, rows = 0, Gathered(self._message)
        try:
            with closing(self._connected()) as connection:
                names = self._topics(connection)
                places = ', '.join('?' * len(names))
                for key, topic, time, data in connection.execute(
                        'SELECT id, topic_id, timestamp, data FROM messages '
                        f'WHERE topic_id IN ({places}) ORDER BY id', list(names)):
                    rows.add(names[topic], int(time), message_of(bytes(data)), key)
                    count += 1
                    self._contents.at += len(data)
                    if rows.is_full:
                        yield rows.blocks()
        except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
            self._contents.warnings.append(f'{self._name} is cut off or damaged ({error}): read '
                                           f'{count} messages up to there')
        yield rows.blocks()

    def _connected(self) -> sqlite3.Connection:
        return sqlite3.connect(f'{self._path.absolute().as_uri()}?immutable=1', uri=True)

    def _topics(self, connection: sqlite3.Connection) -> dict[int, str]:
        """Return the topics that are wanted, by their key in the database."""
        names = {}
        self._contents.at = 0
        for key, name, kind, encoding in connection.execute(
                'SELECT id, name, type, serialization_format FROM topics'):
            topic = full_name(str(name))
            self._contents.topics[topic] = type_of(str(kind), str(encoding))
            if self._wanted is None or topic in self._wanted:
                names[key] = topic
        return names

    def _message(self, key: int) -> bytes:
        try:
            with closing(self._connected()) as connection:
                (data,), = connection.execute('SELECT data FROM messages WHERE id = ?', (key,))
        except (sqlite3.Error, ValueError):
            return b''  # which is no message of any type
        return message_of(bytes(data))
