"""Scene files of other programs: MoveIt, MPiNets, Avoid Everything and robometrics."""
