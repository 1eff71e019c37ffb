"""StatVO's own claims, measured again: `python -m benchmarks.statvo_claims layers halos ...`; without names, all of them.

Rows go to benchmarks/results/statvo_claims.json, pictures to docs/figures/statvo_*.png. Defeats are rows like victories.
"""
