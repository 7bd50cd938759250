"""Files of planning problems in scenes: MoveIt YAML, MPiNets HDF5 and robometrics YAML."""
