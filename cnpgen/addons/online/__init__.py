"""Planning while the robot moves: moving pucks, hits, and the runtime that executes and replaces plans."""
