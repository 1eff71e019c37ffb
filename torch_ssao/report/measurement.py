"""The record of a measurement: what was compared, on what, and with which result."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from torch_ssao.gbuffer import GBuffer
from torch_ssao.report import rows as row_tools
from torch_ssao.report.choosing import Chosen
from torch_ssao.report.pareto import is_on, pareto_front
from torch_ssao.report.peers import Peer
from torch_ssao.report.rows import Row, Score
from torch_ssao.report.truth import Ceiling, TraceSettings, Truth

if TYPE_CHECKING:
    from torch_ssao.scenes import Scene

FORMAT = "torch_ssao.report"
VERSION = 2


@final
@dataclass(frozen=True)
class Constant:
    """The best constant picture: the mean visibility of the fitted views, and its errors."""

    value: float
    validation: Score
    training: Score


@final
@dataclass(frozen=True, eq=False)
class Measurement:
    """What was measured, and all that pictures of it need.

    Args:
        scene: what was rendered.
        out: folder of the files written.
        settings: size, radius, samples of the reference.
        fit_views, judged_views: indices into `scene.cameras`.
        rows: untuned modules by technique and count, then the fitted ones.
        constant, ceiling: the two lines every error lies between.
        gbuffer, truth: of the judged views.
        environment: see `environment.environment`.
        files: everything written so far, relative to `out`.
        peers: results of other implementations, from a file.
        chosen: the choice among the fitted modules.
    """

    scene: Scene
    out: Path
    settings: TraceSettings
    fit_views: tuple[int, ...]
    judged_views: tuple[int, ...]
    rows: tuple[Row, ...]
    constant: Constant
    ceiling: Ceiling
    gbuffer: GBuffer
    truth: Truth
    environment: dict[str, Any]
    files: tuple[str, ...]
    peers: tuple[Peer, ...] = ()
    chosen: Chosen | None = None

    @property
    def techniques(self) -> tuple[str, ...]:
        """Names in `modules.TECHNIQUES` of what was compared, each once."""
        return tuple(dict.fromkeys(row.technique for row in self.rows))

    @property
    def judged_on_training_views(self) -> bool:
        """Whether no view was left to judge on, so that the errors flatter the fit."""
        return set(self.judged_views) <= set(self.fit_views)

    @property
    def judged_label(self) -> str:
        """The judged views in words."""
        kind = "training view" if self.judged_on_training_views else "view"
        return f"{kind}{'s' if len(self.judged_views) > 1 else ''} {', '.join(map(str, self.judged_views))}"

    def as_dict(self) -> dict[str, Any]:
        """The measurement as plain values, as in report.json."""
        front = pareto_front(self)
        scene = {"name": self.scene.name, "faces": len(self.scene.faces), "fingerprint": self.scene.fingerprint}
        return row_tools.plain(
            {
                "format": FORMAT,
                "version": VERSION,
                "scene": scene | {"views": len(self.scene.cameras), "suggested_radius": self.scene.radius},
                "settings": asdict(self.settings),
                "fit_views": self.fit_views,
                "judged_views": self.judged_views,
                "judged_on_training_views": self.judged_on_training_views,
                "techniques": self.techniques,
                "chosen": None if self.chosen is None else asdict(self.chosen),
                "rows": [row.as_dict() | {"pareto": is_on(front, row)} for row in self.rows],
                "peers": [peer.as_dict() | {"pareto": is_on(front, peer)} for peer in self.peers],
                "constant": asdict(self.constant),
                "ceiling": asdict(self.ceiling),
                "environment": self.environment,
                "files": self.files,
            }
        )
