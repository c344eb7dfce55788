"""Benchmarks: ``python -m physpose_torch.bench``. Nothing else in the package imports this folder."""
