"""Why a boundary problem has no solution, where that can be proven."""
