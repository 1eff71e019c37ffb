"""Techniques on meshes of your own, fitted and judged against ray-traced references: `python -m benchmarks.real_scenes`."""
