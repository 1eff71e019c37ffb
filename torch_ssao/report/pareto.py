"""Which points of a speed-against-error plot no other point beats in both."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch_ssao.report.peers import Peer
from torch_ssao.report.rows import Row

if TYPE_CHECKING:
    from torch_ssao.report.measure import Measurement

Entry = Row | Peer


def entries(measurement: Measurement) -> list[Entry]:
    """Everything with an error and, but for some peers, a time: ours, then the peers."""
    return [*measurement.rows, *measurement.peers]


def pareto_front(measurement: Measurement) -> list[Entry]:
    """The entries that no other beats in both validation RMSE and median time, cheapest first; of equals the first."""
    timed = [(entry.timing.median_ms, entry.validation.rmse, entry) for entry in entries(measurement) if entry.timing]
    front: list[Entry] = []
    for _, error, entry in sorted(timed, key=lambda item: item[:2]):
        if not front or error < front[-1].validation.rmse:
            front.append(entry)
    return front


def is_on(front: list[Entry], entry: Entry) -> bool:
    """Whether an entry itself, and not one equal to it, is on a front."""
    return any(entry is other for other in front)
