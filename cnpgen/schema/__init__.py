"""What may be written, in TOML and in Python: keys with units and bounds, kinds by name, recipe files."""
