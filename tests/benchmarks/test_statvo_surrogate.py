"""The surrogate gradient predicts the noise-smoothed image better than the exact one does."""

from __future__ import annotations

import pytest

import torch_ssao as ts
from benchmarks.statvo_surrogate import DEFAULT_WIDTH, score


@pytest.mark.slow
@pytest.mark.parametrize("scene", ts.scenes.names())
def test_surrogate_beats_exact(scene: str) -> None:
    row = score(scene, DEFAULT_WIDTH, list(range(16)))
    assert row["gain_over_standard_error"] > 2, row


def test_default_width_is_that_of_the_module() -> None:
    assert ts.StatVO().surrogate_width == DEFAULT_WIDTH
