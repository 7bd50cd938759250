"""Sequential quadratic programming over the transcribed problem."""
