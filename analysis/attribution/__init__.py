"""Cases of attribution, the oracle beside them, and their scores; see attribution_benchmark.py."""
