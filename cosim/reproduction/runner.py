"""Runs the jobs of figures and checks, in parallel processes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.processes.worker_pool import Pool
from vcmvsp.cosim.runs.api import Result, run

Read = Callable[[Result], Any]
T = TypeVar("T")


@dataclass(frozen=True)
class Job:
    """A run and the function that reads its result; ``read`` must be a module-level function, for other processes."""

    scenario: Mapping[str, Any]
    read: Read
    set: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None

    def __call__(self) -> Any:
        """The value read from the result."""
        return self.read(run(self.scenario, seed=self.seed, set=self.set, mcap=False))


class Runner:
    """Runs jobs, in processes if there are several: `Job` objects, or `functools.partial` of other work.

    Args:
        jobs: number of processes; 1: this one.
        progress: called after every job with the finished and the total number.
    """

    def __init__(self, jobs: int = 1, progress: Callable[[int, int], None] | None = None) -> None:
        self._jobs, self._progress = jobs, progress or (lambda *_: None)

    def __call__(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of the jobs."""
        workers = min(self._jobs, len(jobs))
        if workers <= 1:
            return [self._tell(done, len(jobs), _do(job)) for done, job in enumerate(jobs, 1)]
        died = VcmvspError("a process that ran a part of the figure died twice; --jobs 1 runs all in this one")
        with Pool(_do, workers, died=died, imports=(__name__,)) as pool:
            answers_by_place = pool.answers(enumerate(jobs), len(jobs))
            answers = dict(self._tell(done, len(jobs), answer) for done, answer in enumerate(answers_by_place, 1))
        return [answers[place] for place in range(len(jobs))]

    def _tell(self, done: int, of: int, answer: T) -> T:
        self._progress(done, of)
        return answer


def _do(job: Callable[[], T]) -> T:
    return job()
