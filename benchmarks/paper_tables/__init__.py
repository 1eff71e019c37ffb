"""The tables of the two papers, on scenes at hand, against ray-traced references: `python -m benchmarks.paper_tables`."""
