"""Where the samples of a running node are kept: what it asks of a store, and none at all."""
from __future__ import annotations

from typing import Protocol

from handeye_ros.config import Config
from handeye_ros.sampling.stops import Outcome


class Store(Protocol):
    """
    Keeps what a session is made of.

    All calls but settle return when it is on the disk, or raise.
    """

    @property
    def path(self) -> str:
        """Return the folder of the session, empty before there is one."""

    def add(self, outcome: Outcome, config: Config) -> Outcome:
        """Keep what became of a stop; return it, to be loaded from there; UnwritableError."""

    def remove(self, number: int, config: Config) -> None:
        """Keep that a sample was removed; raises UnwritableError."""

    def configured(self, config: Config) -> None:
        """Keep another configuration; raises UnwritableError."""

    def settle(self) -> None:
        """Keep what else helps to read it; no answer waits for that."""

    def restart(self, config: Config) -> str:
        """Begin another session; return what to say of the one before; UnwritableError."""


class NoStore:
    """Keeps nothing but what is in memory."""

    path = ''

    def add(self, outcome: Outcome, config: Config) -> Outcome:
        """Return the outcome as it is."""
        return outcome

    def remove(self, number: int, config: Config) -> None:
        """Do nothing."""

    def configured(self, config: Config) -> None:
        """Do nothing."""

    def settle(self) -> None:
        """Do nothing."""

    def restart(self, config: Config) -> str:
        """Do nothing."""
        return ''
