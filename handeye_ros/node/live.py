"""
A running session without ROS: streams, samples, review, answer and verification.

One thread evaluates the stops, which is urgent. Another computes review, advice and a new answer,
always for the newest state, so that no work accumulates.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
import threading
import traceback

from handeye_ros.bags.session_store import OutputFolders, Store
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Calibration, TimedPose
from handeye_ros.errors import HandeyeError
from handeye_ros.node.answer import Answer, Reviewer
from handeye_ros.node.live_verify import LiveVerification
from handeye_ros.node.samples import LiveSamples
from handeye_ros.node.streams import Streams
from handeye_ros.node.worker import Evaluator, Progress, Runner, trim_memory
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Outcome


class Threads:
    """Threads that repeat one task each when they are woken; failures are kept as text."""

    def __init__(self, on_failure: Callable[[str], object]) -> None:
        """Start with none; on_failure: receives the traceback of a failed task."""
        self._on_failure = on_failure
        self._failures: dict[str, str] = {}
        self._ended = False

    @property
    def failure(self) -> str:
        """Return why the last run of each task failed, '' if it did not."""
        return '; '.join(self._failures.values())

    def start(self, wake: threading.Event, work: Callable[[], None]) -> None:
        """Start a thread that runs a task each time it is woken, until the process ends."""
        threading.Thread(target=self._run, args=(wake, work), name=work.__name__,
                         daemon=True).start()

    def stop(self) -> None:
        """Start no further tasks, and report no further failures."""
        self._ended = True

    def _run(self, wake: threading.Event, work: Callable[[], None]) -> None:
        while not self._ended:
            wake.wait()
            wake.clear()
            try:
                work()
                self._failures.pop(work.__name__, None)
            except HandeyeError as error:  # such as a process that ended: one more try
                if work.__name__ not in self._failures:
                    wake.set()
                self._failures[work.__name__] = str(error)
            except Exception as error:  # noqa: BLE001 - the thread must continue
                if self._ended:
                    return
                self._failures[work.__name__] = (
                    f'the work on the samples failed, which should not happen: {error!r}; see '
                    'the log, and please report it')
                self._on_failure(traceback.format_exc())


class LiveSession:
    """
    All functions of the running node, composed of parts.

    on_outcome: called with each new outcome of a stop; on_change: after every change of the state;
    on_failure: with the traceback of a failed task of a thread.
    """

    def __init__(self, config: Config, folders: OutputFolders, store: Store | None = None,
                 solver: Runner | None = None, evaluation: Runner | None = None) -> None:
        """
        Start without samples; raises BadValueError for a method that does not exist.

        solver: runs long computations; evaluation: runs the evaluation of stops.
        """
        self.folders = folders
        self.solver, self._evaluator = solver or Runner(), Evaluator(evaluation or Runner())
        self.progress = Progress()
        self.streams = Streams(config)
        self.samples = LiveSamples(self.streams, self._evaluator, store or Store(), self.progress)
        self.reviewer = Reviewer(self.samples, self.solver)
        self.answer = Answer(self.samples, self.solver, folders, self.progress)
        self.verification = LiveVerification(self.samples, self.answer, folders, self.solver,
                                             self.progress)
        self._evaluated = threading.Event()  # wakes the thread of review, advice and answer
        self.threads = Threads(lambda text: self.on_failure(text))
        self.samples.objection = self.reviewer.objection
        self.samples.on_outcome = lambda outcome: self.on_outcome(outcome)
        self.on_outcome: Callable[[Outcome], None] = lambda outcome: None
        self.on_failure: Callable[[str], object] = lambda text: None
        self.on_change: Callable[[], None] = lambda: None
        for component in (self.progress, self.answer, self.reviewer, self.verification):
            component.on_change = lambda: self.on_change()

    @property
    def config(self) -> Config:
        """Return the current settings."""
        return self.streams.config

    @property
    def framed(self) -> Config:
        """Return the current settings with the frame of the poses as the base frame."""
        return self.streams.session.with_base(self.config)

    @property
    def calibration(self) -> Calibration | None:
        """Return the last answer; None before it, and after a refusal."""
        return self.answer.calibration

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the current warnings, one sentence each."""
        return (*self.verification.warnings, *self.streams.warnings,
                *filter(None, (self._evaluator.trouble,)))

    def copied(self) -> Session:
        """Return a copy of the session at this moment."""
        return self.streams.copied()

    def add_profile(self, profile: AnyProfile) -> None:
        """Add a profile."""
        self.streams.add_profile(profile)
        self.verification.add_profile(profile)

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Add poses."""
        poses = list(poses)
        self.streams.add_poses(poses)
        self.verification.add_poses(poses)

    def start(self) -> None:
        """Start the threads."""
        self._evaluator.begin()
        self.threads.start(self.streams.wake, self._evaluate_stops)
        self.threads.start(self._evaluated, self._derive)

    def stop(self) -> None:
        """End the threads and worker processes."""
        self.threads.stop()
        self.solver.stop()
        self._evaluator.stop()

    def restore(self, session: Session, old_config: Config) -> str:
        """Continue with the samples of an earlier run and solve; see LiveSamples.restore."""
        text = self.samples.restore(session, old_config)
        self.answer.restored(session)
        return text

    def replace_session(self, store: Store, session: Session, old_config: Config) -> str:
        """Continue with another session; see LiveSamples.restore."""
        with self.samples.work:
            self.verification.end()
            self.samples.forget()
            self.samples.store.close()
            store.joints, self.samples.store = self.samples.store.joints, store
            text = self.restore(session, old_config)
        self._withdraw('another session was opened')
        return text

    def _evaluate_stops(self) -> None:
        self.samples.evaluate_all()
        self.on_change()
        self._evaluated.set()
        self.samples.store.sync()
        trim_memory()

    def update(self) -> None:
        """Run the tasks of the threads once, in this thread."""
        self.samples.evaluate_all()
        self._derive()

    def _derive(self) -> None:
        """Update everything that depends on the current samples."""
        self.samples.extract_again()
        self.answer.update()  # first: after a restart a person waits for it
        self.reviewer.update()

    # services; each returns its message

    def clear_samples(self) -> str:
        """Forget samples, verification, answer, and all messages; raises InputError."""
        with self.samples.work:
            self.verification.end()
            text = self.samples.clear()
        self.answer.requested = False
        self._withdraw('the samples were cleared')
        return text

    def _withdraw(self, reason: str) -> None:
        """Remove answer, review and guidance."""
        self.answer.withdraw(reason)
        with self.streams.lock:
            self.reviewer.clear()
        self.on_change()

    def configure(self, config: Config) -> None:
        """Apply another configuration, already checked by params.changed."""
        old_config = self.config
        self.verification.configured(old_config, config)
        self.samples.configure(config)
        self.answer.configured(old_config, config)
        self.reviewer.configured(old_config, config)
        self.streams.wake.set()
