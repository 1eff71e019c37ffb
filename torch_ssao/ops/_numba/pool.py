"""Blocks of work over as many threads as torch uses: serial kernels that release the GIL, in threads of our own.

A thread pool of numba's own dies in forked workers, or when two Python threads enter it; this one is made on first use, once
a process, and a forked child makes its own. The calling thread works too, so that no call waits for another's helpers.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, TypeVar

import numpy as np
import torch

BLOCKS = 16  # of an image's rows, for any number of threads: the order in which derivatives are added up

Result = TypeVar("Result")


class _Pool:
    """The helpers of this process."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.executor: ThreadPoolExecutor | None = None
        self.size = 0

    def submit(self, count: int, work: Callable[[], None]) -> list[Future[None]]:
        """Let `count` helpers do the work; those of a smaller pool end after what they do now."""
        with self.lock:
            if self.executor is None or self.size < count:
                if self.executor is not None:
                    self.executor.shutdown(wait=False)
                self.executor, self.size = ThreadPoolExecutor(count, "torch_ssao"), count
            return [self.executor.submit(work) for _ in range(count)]


_pool = _Pool()


def _forget() -> None:
    global _pool
    _pool = _Pool()  # the parent's threads do not exist here


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


class _Run(Generic[Result]):
    """Blocks 0, 1, ...: worked on by whoever is free, handed over one by one in their order."""

    def __init__(
        self, count: int, ahead: int, work: Callable[[int], Result], hand_over: Callable[[Result], None]
    ) -> None:
        self.count, self.ahead, self.work, self.hand_over = count, ahead, work, hand_over
        self.changed = threading.Condition()
        self.started = self.done = 0
        self.waiting: dict[int, Result] = {}
        self.failed = False

    def drain(self) -> None:
        """Work until no block is left."""
        try:
            while (number := self._next()) is not None:
                self._finish(number, self.work(number))
        except BaseException:
            with self.changed:
                self.failed = True
                self.changed.notify_all()
            raise

    def _next(self) -> int | None:
        with self.changed:
            # What waits for its turn takes memory. The block whose turn it is never waits, so this ends.
            while self.started < self.count and self.started > self.done + self.ahead and not self.failed:
                self.changed.wait()
            if self.failed or self.started == self.count:
                return None
            self.started += 1
            return self.started - 1

    def _finish(self, number: int, result: Result) -> None:
        with self.changed:
            self.waiting[number] = result
            while self.done in self.waiting:
                self.hand_over(self.waiting.pop(self.done))
                self.done += 1
            self.changed.notify_all()


def run_blocks(count: int, work: Callable[[int], Result], hand_over: Callable[[Result], None]) -> None:
    """Do blocks 0 ... count - 1 on at most `torch.get_num_threads()` threads; as many, and no more, are held at a time.

    Args:
        work: what a block gives; called in any thread, in any order.
        hand_over: takes the results in the blocks' order, one at a time: what it adds up does not depend on the threads.
    """
    threads = min(torch.get_num_threads(), count)
    run = _Run(count, threads, work, hand_over)
    helpers = _pool.submit(threads - 1, run.drain) if threads > 1 else []
    try:
        run.drain()
    finally:
        started = [helper for helper in helpers if not helper.cancel()]
        errors = [helper.exception() for helper in started]
    for error in errors:
        if error is not None:
            raise error


def row_blocks(batch: int, height: int) -> list[tuple[int, int, int]]:
    """Image, first row and end of every block of a batch of images."""
    rows = -(-height // BLOCKS)
    return [(image, first, min(first + rows, height)) for image in range(batch) for first in range(0, height, rows)]


class Spare:
    """Arrays of zeros, used again."""

    def __init__(self, shape: tuple[int, ...], dtype: Any) -> None:
        self.shape, self.dtype = shape, dtype
        self.lock, self.free = threading.Lock(), []  # type: ignore[var-annotated]

    def take(self) -> Any:
        with self.lock:
            return self.free.pop() if self.free else np.zeros(self.shape, self.dtype)

    def give_back(self, array: Any) -> None:
        with self.lock:
            self.free.append(array)
