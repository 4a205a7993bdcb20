"""Readable NumPy twins of the compiled kernels: the oracles of their tests."""
