"""The stated standard errors are calibrated: over 100 noisy replicas, planted parameters lie where they say."""

from __future__ import annotations

import pytest

from support.calibration import CASES, counts


def check(name: str) -> None:
    found = counts(CASES[name])
    for parameter, (one, two) in found.items():
        assert 58 <= one <= 78, (parameter, found)
        assert two >= 90, (parameter, found)


def test_stated_errors_are_calibrated() -> None:
    check("statvo, two layers")


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_stated_errors_are_calibrated_for_every_technique(name: str) -> None:
    check(name)
