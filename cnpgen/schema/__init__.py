"""Schema of recipes in TOML and Python: keys with units and bounds, registered kinds, recipe files."""
