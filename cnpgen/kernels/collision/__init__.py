"""Compiled collision checks of robots among obstacles; both are arrays, so one library serves all of them."""
