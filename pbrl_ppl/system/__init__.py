"""What touches the machine: files, threads, processes and the terminal's bar of progress."""
