"""Memory of a forward and backward pass: at most twenty G-buffers, whatever the taps; the benchmark's rows, made small."""

from __future__ import annotations

import pytest

import torch_ssao as ts
from benchmarks import memory

SHORT = {  # few taps and four times as many, at a block as small beside the image as usual
    "bitmask": lambda n: ts.HBAO(0.5, slices=n, steps=2 * n, learnable="all"),
    "increments": lambda n: ts.HBAO(0.5, slices=n, steps=2 * n, estimator="increments", learnable="all"),
    "march": lambda n: ts.RayMarchedSSAO(0.5, rays=2 * n, steps=2 * n, learnable="all"),
    "surrogate": lambda n: ts.RayMarchedSSAO(0.5, rays=2 * n, steps=2 * n, gradient="surrogate", learnable="all"),
}


@pytest.mark.parametrize("name", SHORT)
def test_twenty_gbuffers_whatever_the_taps(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setitem(ts.ops.ray_march._TAPS_AT_ONCE, "cpu", 2**14)  # derivatives take an eighth or half
    monkeypatch.setitem(ts.ops.horizon.BLOCK, "cpu", 2**12)
    rows = {f"{name} {n}": (4 * n * n, lambda n=n: SHORT[name](n)) for n in (1, 2)}
    monkeypatch.setattr(memory, "ROWS", rows)
    few, many = (memory.measure(row, 96, 128, tensors=True)["tensor_bytes_per_pixel"] for row in rows)
    assert 20 < many <= memory.BOUND  # less than the inputs' own size would mean that nothing was counted
    assert many <= 1.05 * few


def test_rows_name_their_taps() -> None:
    for name, (taps, make) in memory.ROWS.items():
        net = make()
        counts = net.config()
        assert taps == (2 * counts["slices"] if "slices" in counts else counts["rays"]) * counts["steps"], name
    assert {taps for taps, _ in memory.ROWS.values()} == {64, 256}


def test_a_process_of_its_own_measures_a_row() -> None:
    row = memory.in_process("RayMarchedSSAO exact 8x8", 24, 32, tensors=False)
    assert set(row) == {"name", "taps", "rss_bytes_per_pixel", "seconds"}
    assert row["taps"] == 64
