"""What a valid motion is: the problem, its constraints, its robot, and the problem as text."""
