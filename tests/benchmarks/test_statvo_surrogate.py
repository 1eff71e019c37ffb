"""The surrogate gradient predicts the noise-smoothed image better than the exact one does."""

from __future__ import annotations

import pytest

import torch_ssao as ts
from benchmarks.statvo_surrogate import DEFAULT_WIDTH, score


@pytest.mark.slow
@pytest.mark.parametrize("scene", ts.scenes.names())
def test_surrogate_beats_exact(scene: str) -> None:
    row = score(scene, DEFAULT_WIDTH, list(range(8)))
    # Measured: 1.9 standard errors on temple, 2.0 on stairs, 3.7 to 5.9 on the others.
    assert row["gain_over_standard_error"] > (1 if scene in ("temple", "stairs") else 2), row


def test_default_width_is_that_of_the_module() -> None:
    assert ts.StatVO().surrogate_width == DEFAULT_WIDTH
