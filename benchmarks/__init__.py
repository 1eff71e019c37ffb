"""Benchmarks: rows with commit, device, versions and spread. They never run inside the tests."""
