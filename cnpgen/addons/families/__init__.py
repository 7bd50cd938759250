"""Families of scenes: random generators of furniture, and scenes of them for an arm."""

NEEDS = ("scene_files",)
