"""Simulated recordings of positions alone and their scores; see recordings_benchmark.py."""
