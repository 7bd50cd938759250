"""Plans executed: the arm, the table and the puck or the pedestals in MuJoCo, under a controller that knows less."""
