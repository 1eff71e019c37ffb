"""Compiled CPU kernels of ops beside them: same tensors, same sampling. Imported on first use, since numba is an extra."""
