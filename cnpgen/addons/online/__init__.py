"""Planning while the robot moves: moving pucks, hits, action chunks, and the runtime that executes and replaces plans."""

NEEDS = ("trajectories",)  # its bounds refuse chunks with outliers
