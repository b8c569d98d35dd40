"""Cases of attribution, their oracle and scores; see attribution_benchmark.py."""
