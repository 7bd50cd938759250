"""Interface to the machine: threads, signals, worker processes, versions."""
