"""The same programme for CasADi's solvers, to compare with."""
