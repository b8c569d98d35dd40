"""Code of the reliability runs: drawn cases, faults of files and processes, load and supply."""
