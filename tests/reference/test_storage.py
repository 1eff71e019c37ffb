"""References on disk: whole or not at all, and never code."""

from __future__ import annotations

import dataclasses
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ssao import checks, reference
from torch_ssao.reference import Reference


@pytest.fixture
def result() -> Reference:
    rng = torch.Generator().manual_seed(0)
    valid = torch.rand(2, 1, 6, 8, generator=rng) > 0.2
    visibility = torch.rand(2, 1, 6, 8, generator=rng)
    return Reference(visibility, 0.1 * visibility, valid, 512, 0.75, "linear", 3, "sibénik", "ab12", (0, 4))


def test_round_trip_is_exact(result: Reference, tmp_path: Path) -> None:
    reference.save(result, tmp_path / "new" / "truth.npz")
    again = reference.load(str(tmp_path / "new" / "truth.npz"))
    for field in dataclasses.fields(Reference):
        kept, loaded = getattr(result, field.name), getattr(again, field.name)
        assert torch.equal(kept, loaded) if isinstance(kept, torch.Tensor) else kept == loaded
    assert again.noise == result.noise


def test_saving_replaces_and_leaves_no_other_file(result: Reference, tmp_path: Path) -> None:
    path = tmp_path / "truth"  # numpy would have added .npz
    reference.save(result, path)
    reference.save(dataclasses.replace(result, seed=9), path)
    assert reference.load(path).seed == 9
    assert os.listdir(tmp_path) == ["truth"]


def test_a_failed_save_leaves_the_finished_file(result: Reference, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "truth.npz"
    reference.save(result, path)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(checks.OutputError, match=r"path .*truth.npz' must be writable, got No space left on device"):
        reference.save(dataclasses.replace(result, seed=9), path)
    assert reference.load(path).seed == 3
    assert os.listdir(tmp_path) == ["truth.npz"]


def test_unwritable_folder(result: Reference, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(checks.OutputError, match=r"path's folder .* is not writable"):
        reference.save(result, tmp_path / "file" / "truth.npz")
    (tmp_path / "folder").mkdir()
    with pytest.raises(checks.OutputError, match=r"path .* must be writable"):
        reference.save(result, tmp_path / "folder")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


@pytest.mark.parametrize("kept", [0, 1, 100, 0.5, 0.99])
def test_truncated_file(result: Reference, tmp_path: Path, kept: float) -> None:
    path = tmp_path / "truth.npz"
    reference.save(result, path)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if isinstance(kept, float) else kept])
    with pytest.raises(checks.SceneError, match="damaged or foreign one: trace it again") as caught:
        reference.load(path)
    assert "\n" not in str(caught.value)


def test_damaged_bytes(result: Reference, tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    reference.save(result, path)
    content = path.read_bytes()
    middle = content.index(b"standard_error.npy") + 120  # within the compressed image
    path.write_bytes(content[:middle] + bytes(b ^ 255 for b in content[middle : middle + 8]) + content[middle + 8 :])
    with pytest.raises(checks.SceneError, match="damaged or foreign"):
        reference.load(path)


def test_foreign_files(result: Reference, tmp_path: Path) -> None:
    path = tmp_path / "foreign"
    with path.open("wb") as file:
        np.savez(file, image=np.zeros(3))
    foreign = [path.read_bytes(), b"a text", pickle.dumps({"format": 1}), b"\x89PNG\r\n"]
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    foreign.append(path.read_bytes())
    with path.open("wb") as file:
        np.savez(file, facts=np.array('{"format": "something else"}'))
    foreign.append(path.read_bytes())
    with path.open("wb") as file:
        np.savez(file, facts=np.array([1, 2]))
    foreign.append(path.read_bytes())
    for content in foreign:
        path.write_bytes(content)
        with pytest.raises(checks.SceneError, match="damaged or foreign"):
            reference.load(path)


def test_pickled_objects_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "evil.npz"
    np.savez(path, facts=np.array([{"format": "torch_ssao reference 1"}], dtype=object))
    with pytest.raises(checks.SceneError, match="damaged or foreign"):
        reference.load(path)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(checks.SceneError, match="must be a saved reference, got No such file"):
        reference.load(tmp_path / "none.npz")
    with pytest.raises(checks.SceneError, match="must be a saved reference, got Is a directory"):
        reference.load(tmp_path)


def test_the_record_checks_its_images(result: Reference) -> None:
    with pytest.raises(checks.ShapeError, match=r"standard_error must have shape \(2, 1, 6, 8\)"):
        dataclasses.replace(result, standard_error=torch.zeros(1, 1, 6, 8))
    with pytest.raises(checks.DtypeError, match=r"valid must be torch.bool, got torch.float32"):
        dataclasses.replace(result, valid=torch.zeros(2, 1, 6, 8))
