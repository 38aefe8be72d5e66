"""Weighted rays that stand for radiance and importance [thesis 5.2.2]."""
