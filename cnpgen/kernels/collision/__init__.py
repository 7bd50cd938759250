"""Compiled collision checks of robots among obstacles.

Both are arrays, so one library serves all of them.
"""
