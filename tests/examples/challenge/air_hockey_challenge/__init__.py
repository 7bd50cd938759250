"""A stand-in for the environment of the Air Hockey Challenge: what cnpgen uses of it, on another MuJoCo model."""
