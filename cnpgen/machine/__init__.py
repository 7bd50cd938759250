"""The machine under the process: threads, signals, worker processes, versions."""
