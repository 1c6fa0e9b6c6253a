"""Bounds of hash-grid fields over sets of camera poses (design.md, H)."""
