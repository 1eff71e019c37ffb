"""Which points of a speed-against-error plot no other point beats in both."""

from __future__ import annotations

from typing import Protocol

from torch_ssao.report.peers import Peer
from torch_ssao.report.rows import Row

Entry = Row | Peer


class Compared(Protocol):
    """What was measured here, and by others."""

    @property
    def rows(self) -> tuple[Row, ...]: ...

    @property
    def peers(self) -> tuple[Peer, ...]: ...


def entries(measurement: Compared) -> list[Entry]:
    """Everything with an error and, but for some peers, a time: ours, then the peers."""
    return [*measurement.rows, *measurement.peers]


def pareto_front(measurement: Compared) -> list[Entry]:
    """The entries that no other beats in both validation RMSE and median time, cheapest first; of equals the first.

    A module does the same work untuned and fitted, so that only noise tells their times apart: of the two the one of less
    error competes.
    """
    timed = [
        (entry.timing.median_ms, entry.validation.rmse, entry) for entry in _competing(measurement) if entry.timing
    ]
    front: list[Entry] = []
    for _, error, entry in sorted(timed, key=lambda item: item[:2]):
        if not front or error < front[-1].validation.rmse:
            front.append(entry)
    return front


def _competing(measurement: Compared) -> list[Entry]:
    better: dict[str, Row] = {}
    for row in sorted(measurement.rows, key=lambda row: (row.validation.rmse, not row.is_fitted)):
        better.setdefault(row.name, row)
    return [*better.values(), *measurement.peers]


def is_on(front: list[Entry], entry: Entry) -> bool:
    """Whether an entry itself, and not one equal to it, is on a front."""
    return any(entry is other for other in front)
