"""The planner: a trained model asked for plans, and what it needs of kinematics and limits around the network."""
