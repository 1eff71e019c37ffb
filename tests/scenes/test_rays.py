"""Embree behind float64 distances."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from torch_ssao.checks import SceneError
from torch_ssao.scenes import rays as rays_module
from torch_ssao.scenes.rays import RayCaster, worker_count

SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def test_first_hit_distance_is_exact_far_from_the_origin() -> None:
    shift = np.array([1e5, -2e5, 3e5])  # float32 alone would be off by 0.02
    caster = RayCaster(SQUARE + shift, HALVES)
    rng = np.random.default_rng(0)
    target = np.concatenate((rng.uniform(-0.9, 0.9, (200, 2)), np.zeros((200, 1))), axis=1)
    eye = np.array([0.3, 0.2, -3.7])
    triangle, distance = caster.first_hit(eye + shift, target - eye)
    assert (triangle >= 0).all()
    np.testing.assert_allclose(distance, 1.0, rtol=0, atol=1e-8)
    assert set(triangle) == {0, 1}


def test_misses_and_limits() -> None:
    caster = RayCaster(SQUARE, HALVES)
    origins = np.array([[0.1, 0.2, -2.0], [0.1, 0.2, -2.0], [5.0, 0.2, -2.0]])
    forward = np.tile([0.0, 0.0, 1.0], (3, 1))
    triangle, distance = caster.first_hit(origins, forward, np.array([1.9, 2.1, 9.0]))
    assert (triangle >= 0).tolist() == [False, True, False]
    assert distance.tolist() == [np.inf, 2.0, np.inf]
    local, along = caster.to_local(origins), forward.astype(np.float32)
    reach = np.array([1.9, 2.1, 9.0], np.float32)
    assert caster.occluded(local, along, reach).tolist() == [False, True, False]
    np.testing.assert_allclose(caster.distance(local, along, reach), [1.9, 2.0, 9.0], rtol=1e-6)
    assert caster.occluded(local, along, 1.0).tolist() == [False] * 3


def test_distances_count_in_lengths_of_the_direction() -> None:
    caster = RayCaster(SQUARE, HALVES)
    _, distance = caster.first_hit(np.array([0.1, 0.2, -2.0]), np.array([[0.0, 0.0, 4.0]]))
    assert distance[0] == pytest.approx(0.5, abs=1e-12)


def test_read_only_arrays() -> None:
    caster = RayCaster(SQUARE, HALVES)
    origins, directions = (np.array([[0.1, 0.2, z]], np.float32) for z in (-2.0, 1.0))
    reach = np.array([3.0], np.float32)
    for array in (origins, directions, reach):
        array.setflags(write=False)
    assert caster.occluded(origins, directions, reach).all()
    assert caster.first_hit(origins.astype(float), directions, reach)[0][0] >= 0


def test_no_rays() -> None:
    caster = RayCaster(SQUARE, HALVES)
    triangle, distance = caster.first_hit(np.zeros((0, 3)), np.zeros((0, 3)))
    assert triangle.shape == distance.shape == (0,)


def test_threads_and_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    caster = RayCaster(SQUARE, HALVES)
    directions = np.random.default_rng(1).normal(size=(5000, 3))
    eye = np.array([0.1, 0.0, -0.5])
    whole = caster.first_hit(eye, directions, threads=1)
    monkeypatch.setattr(rays_module, "CHUNK_RAYS", 333)
    for threads in (1, 2, 3):
        parts = caster.first_hit(eye, directions, threads=threads)
        assert all(np.array_equal(a, b) for a, b in zip(whole, parts, strict=True))
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda _: caster.first_hit(eye, directions)[0], range(8)))
    assert all(np.array_equal(answer, whole[0]) for answer in answers)
    assert worker_count() >= 1


def test_embreex_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(SceneError, match=r"embreex.*pip install torch_ssao\[scenes\]"):
        RayCaster(SQUARE, HALVES)
